"""Numbers of NumPy and torch in a task: they work, or are refused when the task is made."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from phihp_torchrl import Agent, Box, ConfigError, Constant, get_task, load_agent, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.tasks import Actuator, Constraint, Signal, Task

CARTPOLE = get_task("cartpole-swingup")
one, two = np.float32(1.0), np.array(2.0)


def test_a_task_of_numpys_numbers_equals_one_of_plain_ones_and_is_saved(tmp_path) -> None:
    ours = replace(
        CARTPOLE,
        action_high=np.array([10.0]),
        action_low=[np.float64(-10.0)],
        time_step=np.float64(0.02),
        max_steps=np.int64(100),
        reset=Box(np.zeros(4), torch.ones(4)),
        velocity_limits={"x_dot": np.float32(8.0)},
        position_limits={"x": np.array([-1.0, 1.0])},
        restitution=two - 1.5,
        action_rate_limit=np.array([5.0]),
        action_rate_cost=one,
        actuator=Actuator(delay_steps=np.int64(1), lag=np.array([0.5])),
        constraints=(Constraint("x", low=-one, high=two, price=np.int64(3)),),
    )
    plain = replace(
        CARTPOLE,
        action_high=(10.0,),
        action_low=(-10.0,),
        time_step=0.02,
        max_steps=100,
        reset=Box((0.0,) * 4, (1.0,) * 4),
        velocity_limits={"x_dot": 8.0},
        position_limits={"x": (-1.0, 1.0)},
        restitution=0.5,
        action_rate_limit=(5.0,),
        action_rate_cost=1.0,
        actuator=Actuator(delay_steps=1.0, lag=(0.5,)),
        constraints=(Constraint("x", low=-1.0, high=2.0, price=3),),
    )
    assert ours == plain
    save_agent(Agent(ours, actor=Actor(ours, (4,))), tmp_path)
    assert load_agent(tmp_path, task=plain).task == plain


def test_constants_and_signals_take_numpys_numbers() -> None:
    assert Constant(one, low=np.array(0.0), high=two) == Constant(1.0, high=2.0)
    signal = Signal(("x",), np.array([-1.0]), (one,))
    assert json.dumps(signal.config) == json.dumps(Signal(("x",), (-1.0,), (1.0,)).config)


HOSTILE = st.one_of(
    st.floats(),
    st.sampled_from([math.nan, math.inf, -1, 0, 1e300, 10**400, True, "x", None, b"x", object()]),
    st.sampled_from([np.float32("nan"), np.array([1.0, math.nan]), np.ones((2, 2))]),
    st.lists(st.floats(), max_size=4),
    st.dictionaries(st.sampled_from(["x", "x_dot", "y"]), st.floats() | st.text(max_size=2)),
)


@settings(max_examples=100, deadline=None)
@given(st.sampled_from([f.name for f in fields(Task) if f.init]), HOSTILE)
def test_any_value_of_a_task_is_refused_by_a_message_or_kept_as_plain_numbers(
    name: str, value: Any
) -> None:
    try:
        task = replace(CARTPOLE, **{name: value})
    except ConfigError:
        return
    kept = getattr(task, name)
    assert not hasattr(kept, "shape"), name
    if isinstance(kept, float):
        assert type(kept) is float
        assert math.isfinite(kept)


@pytest.mark.parametrize("low", [(math.nan,), (-1e39,), ("x",), (None,), (2.0,), (-3e38,)])
def test_a_box_holds_numbers_that_float32_holds(low: Any) -> None:
    with pytest.raises(ConfigError, match="low"):
        Box(low, (3e38,) if low == (-3e38,) else (1.0,))
