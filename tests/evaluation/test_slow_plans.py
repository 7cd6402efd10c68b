"""What is said of an agent whose plans take longer than a time step."""

from __future__ import annotations

import logging

import pytest

from phihp_torchrl.evaluation import warn_of_slow_plans
from phihp_torchrl.planners import CEMConfig, MPPIConfig

from .policies import planner

STEP = 50.0  # ms, of the pendulum
SMALLER, NATIVE, ACTOR = "budget=fast", "compile=True", "planner=False"


def told(caplog: pytest.LogCaptureFixture, agent, milliseconds: float = STEP + 1) -> str:
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        warn_of_slow_plans(agent, milliseconds)
    return caplog.text


def test_one_warning_names_both_times_and_what_is_faster(caplog):
    agent = planner(planning_horizon=9)
    text = told(caplog, agent, 123.4)
    assert len(caplog.records) == 1
    assert "A plan takes 123 ms, and the time step is 50 ms: choose a smaller plan" in text
    assert all(words in text for words in (SMALLER, NATIVE, ACTOR))
    assert not told(caplog, agent, STEP)


def test_an_agent_whose_actor_acts_has_no_plans(caplog):
    agent = planner()
    assert not told(caplog, agent.actor_alone())
    agent.metadata = {"acting": "actor"}
    assert not told(caplog, agent)
    agent.metadata = {"acting": "planner"}
    assert told(caplog, agent)


def test_only_what_there_is_is_named(caplog):
    assert SMALLER not in told(caplog, planner())  # it is smaller than that already
    agent = planner(planning_horizon=9)
    assert NATIVE not in told(caplog, agent.with_planner(agent.planner_config, compile=True))
    assert SMALLER not in told(caplog, agent.with_planner(MPPIConfig(planning_horizon=9)))
    alone = type(agent)(
        agent.task,
        dynamics=agent.dynamics,
        planner_config=CEMConfig(
            planning_horizon=3, optim_steps=1, num_candidates=8, top_k=2, num_policy_candidates=0
        ),
    )
    text = told(caplog, alone)
    assert NATIVE in text
    assert ACTOR not in text


def test_a_plan_that_was_compiled_ahead_is_native(caplog):
    agent = planner(planning_horizon=9)
    arguments, _ = agent.planner.example_call(agent.example())
    agent.planner.replace_plan(arguments, agent.planner.plan_eagerly)
    text = told(caplog, agent)
    assert SMALLER in text
    assert NATIVE not in text
