"""Constraints that the settings of a run give to a task."""

from dataclasses import replace

import pytest

from phihp_torchrl import Agent, ConfigError, Constraint, get_task, load_config
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import load_agent, save_agent
from phihp_torchrl.trainers import read_run_config
from phihp_torchrl.trainers.run_config import RunConfig, task_of

OWN = replace(
    get_task("cartpole-swingup"),
    constraints=(
        Constraint("x", -1.0, 1.0, price=5.0),
        Constraint("spin", high=9.0, price=1.0, function=lambda state: state[..., 3].abs()),
    ),
)


def task_with(constraints, own=None):
    return task_of(RunConfig("cartpole-swingup", constraints=constraints), own)


def test_a_run_sets_limits_of_states_and_its_agent_keeps_them(tmp_path):
    short = ["constraints.x.low=-1", "constraints.x.high=1", "constraints.x.price=5"]
    config = read_run_config(load_config("cartpole-swingup", overrides=short))
    task = task_of(config)
    assert task.constraints == (Constraint("x", -1.0, 1.0, price=5.0),)
    assert read_run_config(config.to_mapping()) == config
    save_agent(Agent(task, actor=Actor(task)), tmp_path / "agent")
    assert load_agent(tmp_path / "agent").task.constraints == task.constraints


def test_a_run_changes_and_drops_the_tasks_own():
    near, spin = task_with({"x": {"price": 1}, "spin": {"high": 4.0}}, OWN).constraints
    assert near == Constraint("x", -1.0, 1.0, price=1.0)
    assert spin == replace(OWN.constraints[1], high=4.0)
    assert task_with({"x": None}, OWN).constraints == OWN.constraints[1:]
    (end,) = task_with({"x": {"high": 2.0, "hard": True}}).constraints
    assert end == Constraint("x", high=2.0, hard=True)
    assert task_with({}, OWN) is OWN


@pytest.mark.parametrize(
    ("constraints", "key"),
    [
        ({"x": {"hihg": 1}}, "constraints.x.hihg"),
        ({"x": {"function": "f", "high": 1.0, "price": 1.0}}, "constraints.x.function"),
        ({"x": {"high": "far"}}, "constraints.x.high"),
        ({"x": {"high": 1.0}}, "constraints.x.price"),
        ({"x": 1}, "constraints.x"),
        ({"x": None}, "constraints.x"),
        ({"y": {"high": 1.0, "price": 1.0}}, "constraints.y"),
    ],
)
def test_what_is_wrong_is_refused_by_name(constraints, key):
    with pytest.raises(ConfigError) as error:
        task_with(constraints)
    assert error.value.key == key
