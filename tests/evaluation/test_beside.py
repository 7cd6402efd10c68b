"""Baselines beside an agent: the same episodes, its own model, and where they are not played."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phihp_torchrl import Agent, ConfigError, HybridDynamics, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.evaluation import controllers_table, evaluate, play_baselines
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.worlds import SimulatedWorld

TASK = replace(get_task("pendulum"), max_steps=20)


def agent_of(task=TASK) -> Agent:
    return Agent(task, dynamics=HybridDynamics.pure_prior(task), actor=Actor(task))


def test_they_play_the_same_episodes_and_are_timed() -> None:
    world, agent = SimulatedWorld(TASK), agent_of()
    found = play_baselines(agent, world, episodes=3, seed=5, latency_actions=2)
    assert found.keys() == {"lqr", "pid", "energy"}
    assert found["lqr"]["latency_ms_mean"] > 0
    from phihp_torchrl.baselines import LQR

    alone = evaluate(LQR.from_model(TASK, agent.dynamics), TASK, episodes=3, seed=5, world=world)
    assert found["lqr"]["returns"] == alone.returns.tolist()


def test_random_states_are_kept() -> None:
    agent = agent_of()
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    play_baselines(agent, SimulatedWorld(TASK), episodes=1)
    torch.testing.assert_close(torch.rand(3), expected)


def test_in_a_world_that_may_be_a_machine_they_play_where_they_are_named() -> None:
    class Rig(SimulatedWorld):
        truth = None  # nobody knows its equations

        def model(self) -> None:
            return None

    late = replace(TASK, actuator=Actuator(delay_steps=1.0))
    agent = agent_of(late)
    assert play_baselines(agent, Rig(late), episodes=1) == {}
    assert play_baselines(agent, Rig(late), ["lqr"], episodes=1).keys() == {"lqr"}


def test_without_a_model_there_are_none(caplog: pytest.LogCaptureFixture) -> None:
    agent = Agent(TASK, actor=Actor(TASK))
    assert play_baselines(agent, SimulatedWorld(TASK)) == {}
    assert caplog.records == []
    assert play_baselines(agent, SimulatedWorld(TASK), ["lqr"]) == {}
    assert "the agent has no model" in caplog.text


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(ConfigError, match="baselines: expected auto, none, or a list"):
        play_baselines(agent_of(), SimulatedWorld(TASK), ["lqg"])


def test_the_table_shows_what_there_is() -> None:
    lqr = {"returns": [1.0, 3.0], "latency_ms_mean": 0.5, "chatter": 0.25}
    lines = controllers_table("cart", {"actor": {"returns": [4.0]}, "lqr": lqr}).splitlines()
    assert lines[0] == "| cart | return | s.e. | chatter | ms |"
    assert lines[2:] == ["| actor | 4.0 | 0.0 | – | – |", "| lqr | 2.0 | 1.0 | 0.250 | 0.500 |"]
