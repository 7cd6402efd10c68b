"""Every kind of agent is saved, loaded, judged and exported, or says why not."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from forked import Forks

from phihp_torchrl import Agent, evaluate, get_task, load_agent, save_agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import AgentError, PlanModule, register_agent
from phihp_torchrl.deployment.export_modules import action_of
from phihp_torchrl.deployment.kinds import AGENT_KINDS
from phihp_torchrl.planners import MPPIConfig
from phihp_torchrl.tdmpc import TOLD, TDMPCAgent, TOLDConfig
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

from .agent_parts import SMALL, act, make_agent, observations

TASK = get_task("pendulum")
PLAIN = replace(SMALL, num_policy_candidates=0)
MPPI = MPPIConfig(
    planning_horizon=3, optim_steps=2, num_candidates=16, top_k=4, num_policy_candidates=4
)
NO_PLANNER = "expected one with a planner"
REMEMBERS = "expected one that plans with a CEMPlanner, got a MPPIPlanner"


def td_mpc(planner_config=MPPI):
    sizes = TOLDConfig(latent_dim=4, encoder_dim=8, mlp_dim=8)
    return TDMPCAgent(TASK, TOLD.for_task(TASK, sizes), planner_config)


def oracle(**changes):
    return SimulatedWorld(TASK, SimulatedConfig(**changes)).oracle()


# How each is made, what its file calls it, and why it is not exported, if so.
KINDS = {
    "PhIHP": (make_agent, "phihp", None),
    "PhIHP by path integral control": (lambda: make_agent(config=MPPI), "phihp", REMEMBERS),
    "TD3": (lambda: make_agent(dynamics=None, config=None), "phihp", NO_PLANNER),
    "an actor": (lambda: Agent(TASK, actor=Actor(TASK, (4,))), "phihp", NO_PLANNER),
    "CEM": (lambda: make_agent(actor=None, qvalue=None, config=PLAIN), "phihp", None),
    "CEM with a warm start": (
        lambda: make_agent(actor=None, qvalue=None, config=replace(PLAIN, warm_start=True)),
        "phihp",
        None,
    ),
    "CEM in the true model": (
        lambda: make_agent(actor=None, qvalue=None, config=PLAIN, dynamics=oracle()),
        "phihp",
        None,
    ),
    "CEM in another world's model": (
        lambda: make_agent(
            actor=None,
            qvalue=None,
            config=PLAIN,
            dynamics=oracle(integrator="rk4", substeps=2, constants={"mass": 1.3}),
        ),
        "phihp",
        None,
    ),
    "CEM in a model that does not compile": (
        lambda: make_agent(
            actor=None, qvalue=None, config=PLAIN, dynamics=oracle(integrator="dopri5")
        ),
        "phihp",
        "expected a model whose integrator compiles",
    ),
    "TD-MPC": (td_mpc, "td-mpc", REMEMBERS),
    "TD-MPC's policy": (lambda: td_mpc(None), "td-mpc", NO_PLANNER),
}
every_kind = pytest.mark.parametrize("name", KINDS)


@every_kind
def test_it_is_loaded_as_it_was_saved(name, tmp_path):
    make, kind, _ = KINDS[name]
    agent = make()
    content = json.loads((save_agent(agent, tmp_path / "one") / "agent.json").read_text())
    assert (content["format_version"], content["kind"]) == (2, kind) == (2, agent.kind)
    assert {key: content[key] for key in agent.config} == agent.config
    loaded = load_agent(tmp_path / "one", task="pendulum")
    assert type(loaded) is type(agent)
    assert loaded.kind == kind
    assert loaded.config == agent.config
    assert loaded.planner_config == agent.planner_config
    assert loaded.modules_by_name().keys() == agent.modules_by_name().keys()
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    td = observations(agent, [5])
    assert torch.equal(act(loaded, td), act(agent, td))
    save_agent(loaded, tmp_path / "two")
    for file in ("agent.json", "weights.safetensors"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


@every_kind
def test_it_acts_without_its_planner_or_says_what_is_missing(name, tmp_path):
    agent = KINDS[name][0]()
    save_agent(agent, tmp_path)
    if agent.actor is None:
        with pytest.raises(AgentError, match="actor: expected one for an agent that does not plan"):
            load_agent(tmp_path, planner=False)
        with pytest.raises(ValueError, match="actor: expected one for an agent that does not plan"):
            agent.actor_alone()
    else:
        alone, td = load_agent(tmp_path, planner=False), observations(agent, [5])
        assert alone.planner is None
        assert alone.planner_config == agent.planner_config
        assert torch.equal(act(alone, td), act(agent.actor_alone(), td))


@every_kind
def test_it_is_judged_like_every_other(name):
    agent, task = KINDS[name][0](), replace(TASK, max_steps=3)
    result = evaluate(agent, task, episodes=4, seed=0)
    assert result.lengths.tolist() == [3] * 4
    assert torch.equal(result.returns, evaluate(agent, task, episodes=4, seed=0).returns)
    assert (result.returns < 0).all()


@every_kind
def test_it_is_exported_or_says_why_not(name):
    make, _, reason = KINDS[name]
    if reason is None:
        module = PlanModule(make())
        with torch.no_grad():
            action = action_of(module(*module.example()))
        assert action.shape == (1,)
        assert action.abs() <= 2.0
    else:
        with pytest.raises(ValueError, match=rf"^agent: {reason}") as error:
            PlanModule(make())
        assert error.value.key == "agent"


def test_a_kind_with_a_folder_of_its_own_is_found_there(tmp_path, forks: Forks):
    """Another process that knows nothing of TD-MPC loads its agents all the same."""
    agent = td_mpc()
    save_agent(agent, tmp_path)
    code = (
        "import sys; from phihp_torchrl import load_agent; "
        "assert 'phihp_torchrl.tdmpc' not in sys.modules; "
        f"agent = load_agent({str(tmp_path)!r}); print(type(agent).__name__, agent.kind)"
    )
    forks.start(code)
    assert forks.end() == (["TDMPCAgent td-mpc"], 0)


# A kind of a user's.


class Lazy(Agent):
    """Does half of what its actor would."""

    kind = "lazy"

    def forward(self, tensordict):
        tensordict = super().forward(tensordict)
        return tensordict.set("action", 0.5 * tensordict["action"])


@pytest.fixture
def lazy(monkeypatch):
    """The kind ``lazy``, known for the time of a test."""
    monkeypatch.setattr(AGENT_KINDS, "_entries", dict(AGENT_KINDS))
    return register_agent(Lazy)


def test_a_users_kind_is_saved_and_loaded(lazy, tmp_path, monkeypatch):
    agent = Lazy(TASK, actor=Actor(TASK, (4,)))
    loaded = load_agent(save_agent(agent, tmp_path))
    td = observations(agent, [5])
    assert type(loaded) is Lazy
    assert torch.equal(act(loaded, td), act(agent, td))
    torch.testing.assert_close(act(loaded, td), 0.5 * agent.actor.module(td["observation"]))
    monkeypatch.delitem(AGENT_KINDS._entries, "lazy")
    with pytest.raises(AgentError, match=r"kind: expected one of .*'phihp'.* got 'lazy'"):
        load_agent(tmp_path)


def test_a_kind_is_registered_once(lazy):
    with pytest.raises(ValueError, match="'lazy' is registered already; pass replace=True"):
        register_agent(Lazy)
    assert register_agent(Lazy, replace=True) is Lazy
