"""Planners by their kind: the ones of this package, and one of a user's."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import (
    Agent,
    CEMPlanner,
    HybridDynamics,
    MPPIPlanner,
    get_task,
    load_agent,
    load_config,
    register_planner,
    save_agent,
)
from phihp_torchrl.agents import Actor, TwinQ, make_actor
from phihp_torchrl.config import choices
from phihp_torchrl.deployment import AgentError
from phihp_torchrl.planners import PLANNERS, CEMConfig, MPPIConfig, SearchConfig, make_planner
from phihp_torchrl.worlds import SimulatedWorld

TASK = get_task("pendulum")


# Those of this package.


def test_planner_gets_every_setting():
    config = CEMConfig(
        planning_horizon=4,
        optim_steps=2,
        num_candidates=12,
        top_k=3,
        num_policy_candidates=2,
        alpha=0.3,
        gamma=0.9,
        num_kept_elites=1,
        select="best",
        replan_every=2,
        warm_start=True,
    )
    model = SimulatedWorld(TASK).model()
    actor = make_actor(TASK, (4,))
    before = torch.get_rng_state()
    planner = make_planner(model, actor, None, config)
    make_planner(model, None, None, replace(config, num_policy_candidates=0))
    assert torch.equal(before, torch.get_rng_state()), "a planner draws nothing until it plans"
    assert type(planner) is CEMPlanner
    assert planner.settings == config
    assert (planner.receding.replan_every, planner.receding.warm_start) == (2, True)


def test_each_kind_makes_its_planner():
    model = SimulatedWorld(TASK).model()
    for config, kind in ((CEMConfig, CEMPlanner), (MPPIConfig, MPPIPlanner)):
        planner = make_planner(model, None, None, config(num_policy_candidates=0))
        assert type(planner) is kind
        assert planner.settings == config(num_policy_candidates=0)
    assert next(iter(PLANNERS)) == "cem", "the default"
    with pytest.raises(ValueError, match="'cem' is registered already; pass replace=True"):
        register_planner("cem", CEMConfig, CEMPlanner.from_config)


# One of a user's.


@dataclass(frozen=True)
class DampedConfig(CEMConfig):
    """Plans by the cross-entropy method, and does less than it plans."""

    kind: ClassVar[str] = "damped"

    damping: float = 0.5


class Damped(CEMPlanner):
    damping = 1.0

    def planning(self, tensordict, noise=None):
        return self.damping * super().planning(tensordict, noise)


def build_damped(env, config, **options):
    plain = CEMConfig(**{f.name: getattr(config, f.name) for f in fields(CEMConfig)})
    planner = Damped.from_config(env, plain, **options)
    planner.damping = config.damping
    return planner


@pytest.fixture
def damped(monkeypatch):
    """The kind ``damped``, known for the time of a test."""
    monkeypatch.setattr(PLANNERS, "_entries", dict(PLANNERS))
    monkeypatch.setattr(choices, "_OFFERED", dict(choices._OFFERED))
    return register_planner("damped", DampedConfig, build_damped, about="does less")


NUMBERS = {
    "planning_horizon": 3,
    "optim_steps": 2,
    "num_candidates": 16,
    "top_k": 4,
    "num_policy_candidates": 4,
}


def make_agent(config):
    torch.manual_seed(0)
    parts = {"actor": Actor(TASK, (8,)), "qvalue": TwinQ(TASK, (8,))}
    return Agent(TASK, dynamics=HybridDynamics.hybrid(TASK), planner_config=config, **parts)


def act(agent):
    torch.manual_seed(1)
    observation = TASK.observe(TASK.coverage.sample([5]))
    return agent(TensorDict(observation=observation, batch_size=[5]))["action"]


def test_an_agent_plans_with_it(damped):
    plain = make_agent(CEMConfig(**NUMBERS))
    agent = make_agent(DampedConfig(**NUMBERS, damping=0.25))
    assert type(agent.planner) is Damped
    torch.testing.assert_close(act(agent), 0.25 * act(plain))
    more = plain.with_planner(DampedConfig(**NUMBERS, damping=0.75))
    torch.testing.assert_close(act(more), 0.75 * act(plain))
    assert torch.equal(act(more.with_planner(CEMConfig(**NUMBERS))), act(plain))


def test_it_is_saved_and_loaded(damped, tmp_path, monkeypatch):
    agent = make_agent(DampedConfig(**NUMBERS, damping=0.25))
    assert agent.config["planner"]["kind"] == "damped"
    assert agent.config["planner"]["damping"] == 0.25
    loaded = load_agent(save_agent(agent, tmp_path))
    assert loaded.planner_config == agent.planner_config
    assert type(loaded.planner) is Damped
    assert torch.equal(act(loaded), act(agent))
    monkeypatch.delitem(PLANNERS._entries, "damped")
    with pytest.raises(AgentError, match=r"planner\.kind: expected one of .*'cem'.*got 'damped'"):
        load_agent(tmp_path)


def test_recipes_know_it_by_name(damped):
    config = load_config("pendulum", overrides=["planner=damped", "planner.damping=0.75"])
    assert config["planner"]["kind"] == "damped"
    assert config["planner"]["damping"] == 0.75


def test_a_taken_name_is_refused(damped):
    with pytest.raises(ValueError, match="'damped' is registered already"):
        register_planner("damped", DampedConfig, build_damped)
    again = register_planner("damped", DampedConfig, build_damped, about="again", replace=True)
    assert PLANNERS["damped"] is again


def test_settings_that_call_themselves_otherwise_are_refused(damped):
    """They would be saved under one name, and built and read under another."""
    for name, config in (("mine", DampedConfig), ("mine", CEMConfig), ("mine", SearchConfig)):
        with pytest.raises(ValueError, match=r"^planner: expected .* 'mine'"):
            register_planner(name, config, build_damped)
        assert name not in PLANNERS


def test_an_unknown_kind_is_refused_by_name():
    with pytest.raises(ValueError, match=r"planner: expected one of .*'cem'.* got 'damped'"):
        make_agent(DampedConfig(**NUMBERS))
