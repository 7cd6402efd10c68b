"""What is loaded is what was saved; what can not be built again is not saved."""

from __future__ import annotations

import logging
import re
import tempfile
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lopsided import LOPSIDED
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP

import phihp_torchrl
from phihp_torchrl import Agent, HybridDynamics, get_task, load_agent, register_task, save_agent
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.config import choices
from phihp_torchrl.deployment import AgentError
from phihp_torchrl.dynamics import PhysicsPrior, ResidualMLP
from phihp_torchrl.integrators import Dopri5, SemiImplicitEuler, make_integrator
from phihp_torchrl.planners import CEMConfig, MPPIConfig
from phihp_torchrl.tasks import Actuator, Constraint, list_tasks, registry
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

from .agent_parts import act, make_agent, observations


def kinds(task):
    return {
        "hybrid": HybridDynamics.hybrid(task, hidden_sizes=(5, 6, 7), constants={}),
        "all outputs": HybridDynamics.hybrid(task, residual_outputs="all", integrator="rk4"),
        "substeps": HybridDynamics.hybrid(task, integrator=make_integrator("rk4", substeps=3)),
        "ensemble": HybridDynamics.hybrid(task, hidden_sizes=(5, 4), ensemble=3),
        "tolerances": HybridDynamics.pure_prior(task, integrator=Dopri5(rtol=1e-3)),
        "data-driven": HybridDynamics.data_driven(task, hidden_sizes=(4,)),
        "pure prior": HybridDynamics.pure_prior(task),
        "oracle": SimulatedWorld(task).oracle(),
        "another oracle": SimulatedWorld(
            task,
            SimulatedConfig(
                integrator="rk4", substeps=2, constants={"pole_mass": 0.3}, friction={"cart": 0.2}
            ),
        ).oracle(),
        "tanh": HybridDynamics(
            task, prior=None, residual=ResidualMLP(task.system, (4,), None, nn.Tanh)
        ),
    }


@pytest.mark.parametrize("name", list_tasks())
def test_round_trip(name, tmp_path):
    agent = make_agent(name)
    for parameter in agent.parameters():
        parameter.data.mul_(1.1)
    metadata = {
        "seed": 3,
        "commit": "abc",
        "returns": {"planner": [-1.5, 2]},
        "config": {"a": None},
    }
    save_agent(agent, tmp_path / "agent", metadata=metadata)
    loaded = load_agent(tmp_path / "agent", task=name)
    assert loaded.metadata == metadata
    assert loaded.task is agent.task
    assert loaded.config == agent.config
    assert loaded.planner_config == agent.planner_config
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    td = observations(agent, [3])
    assert torch.equal(act(agent, td), act(loaded, td))
    alone = load_agent(tmp_path / "agent", planner=False)
    assert torch.equal(act(agent.actor_alone(), td), act(alone, td))
    # What was loaded saves as the same, and keeps its planner even where it does not plan.
    save_agent(alone, tmp_path / "again")
    for file in ("agent.json", "weights.safetensors"):
        assert (tmp_path / "agent" / file).read_bytes() == (tmp_path / "again" / file).read_bytes()


@pytest.mark.parametrize("kind", kinds(get_task("cartpole")))
def test_round_trip_of_every_model(kind, tmp_path):
    agent = make_agent("cartpole", dynamics=kinds(get_task("cartpole"))[kind])
    loaded = load_agent(save_agent(agent, tmp_path))
    state, action = torch.randn(5, 4), torch.randn(5, 1)
    assert torch.equal(agent.dynamics(state, action), loaded.dynamics(state, action))


WIDTHS = st.lists(st.integers(1, 9), min_size=1, max_size=3)


@st.composite
def planners(draw):
    """Settings of either planner, small enough to plan with."""
    candidates = draw(st.integers(2, 12))
    numbers = {
        "planning_horizon": draw(st.integers(1, 3)),
        "optim_steps": draw(st.integers(1, 2)),
        "num_candidates": candidates,
        "top_k": draw(st.integers(1, candidates)),
        "num_policy_candidates": draw(st.integers(0, candidates - 1)),
        "policy_noise": draw(st.floats(0, 1)),
        "policy_noise_clip": draw(st.floats(0, 1)),
        "alpha": draw(st.floats(0, 3)),
        "gamma": draw(st.floats(0, 1)),
        "init_std": draw(st.floats(0.1, 2)),
        "min_std": draw(st.floats(0, 0.1)),
        "tail_dtype": draw(st.sampled_from(["float32", "bfloat16"])),
    }
    if draw(st.booleans()):
        temperature, momentum = draw(st.floats(0, 5)), draw(st.floats(0, 0.9))
        select = draw(st.sampled_from(["sample", "mean"]))
        return MPPIConfig(**numbers, temperature=temperature, momentum=momentum, select=select)
    return CEMConfig(
        **numbers,
        num_kept_elites=draw(st.integers(0, numbers["top_k"])),
        select=draw(st.sampled_from(["mean", "best"])),
        compare_with_actor=draw(st.booleans()),
        actor_margin=draw(st.floats(0, 2)),
        replan_every=draw(st.integers(1, numbers["planning_horizon"])),
        warm_start=draw(st.booleans()),
    )


@given(
    st.sampled_from(["pendulum", "acrobot-swingup", LOPSIDED]),
    st.tuples(WIDTHS, WIDTHS, WIDTHS),
    planners(),
    st.sampled_from([("semi_implicit_euler", 1), ("rk4", 2)]),
    st.integers(0, 2**31),
)
@settings(max_examples=25)
def test_round_trip_of_any_sizes_and_settings(task, widths, planner, integrator, seed):
    torch.manual_seed(seed)
    task = task if task is LOPSIDED else get_task(task)
    name, substeps = integrator
    agent = Agent(
        task,
        dynamics=HybridDynamics.hybrid(
            task, hidden_sizes=widths[0], integrator=make_integrator(name, substeps=substeps)
        ),
        actor=Actor(task, widths[1]),
        qvalue=TwinQ(task, widths[2]),
        planner_config=planner,
        metadata={"seed": seed},
    )
    with tempfile.TemporaryDirectory() as directory:
        loaded = load_agent(save_agent(agent, directory), task=task)
    assert loaded.config == agent.config
    assert loaded.planner_config == planner
    assert type(loaded.planner) is type(agent.planner)
    assert loaded.metadata == {"seed": seed}
    td = observations(agent, [3])
    assert torch.equal(act(loaded, td), act(agent, td))
    assert torch.equal(act(loaded.actor_alone(), td), act(agent.actor_alone(), td))


def test_lopsided_bounds_are_kept(tmp_path):
    """Networks and plans of a loaded agent reach as far as its task, and no further."""
    actor = Actor(LOPSIDED, (8,), last_layer_scale=1e3)
    agent = make_agent(LOPSIDED, actor=actor)
    loaded = load_agent(save_agent(agent, tmp_path), task=LOPSIDED)
    td = observations(agent, [300])
    for policy in (loaded, loaded.actor_alone()):
        action = act(policy, td)
        assert action.min().item() == pytest.approx(-6.0)
        assert action.max().item() == pytest.approx(12.0)
    assert torch.equal(act(loaded, td), act(agent, td))
    for name in ("actor", "qvalue"):
        assert loaded.modules_by_name()[name].bounds.low.item() == -6.0
    other = replace(LOPSIDED, action_low=(-5.0,))
    with pytest.raises(AgentError, match=r"expected its action_low \(-6\.0,\), got \(-5\.0,\)"):
        load_agent(tmp_path, task=other)


def test_the_papers_sizes_stay_under_two_megabytes(tmp_path):
    for name in ("pendulum-swingup", "acrobot-swingup"):
        task = get_task(name)
        agent = make_agent(name, actor=Actor(task), qvalue=TwinQ(task), config=CEMConfig())
        save_agent(agent, tmp_path)
        assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 2e6


def test_saving_replaces_its_files_and_leaves_others(tmp_path):
    (tmp_path / "picture.gif").write_bytes(b"GIF")
    save_agent(make_agent(), tmp_path, metadata={"seed": 0})
    second = make_agent()
    save_agent(second, tmp_path, metadata={"seed": 1})
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"picture.gif", "agent.json", "weights.safetensors"}
    td = observations(second, [2])
    assert torch.equal(act(load_agent(tmp_path), td), act(second, td))


def test_own_tasks(tmp_path, monkeypatch):
    monkeypatch.setattr(registry._TASKS, "_entries", dict(registry._TASKS))
    monkeypatch.setattr(choices, "_OFFERED", dict(choices._OFFERED))
    task = replace(get_task("pendulum"), name="agent-io-pendulum")
    save_agent(Agent(task, actor=Actor(task, (4,))), tmp_path)
    with pytest.raises(AgentError, match=r"expected one of .*'acrobot'.* got 'agent-io-pendulum'"):
        load_agent(tmp_path)
    with pytest.raises(AgentError, match=r"plugins=\[my_task\.py\], or pass it as task"):
        load_agent(tmp_path)
    assert load_agent(tmp_path, task=task).task is task
    assert load_agent(tmp_path, task=replace(task, max_steps=7)).task.max_steps == 7
    with pytest.raises(AgentError, match=r"another one here: expected its time_step 0.05, got 0.1"):
        load_agent(tmp_path, task=replace(task, time_step=0.1))
    register_task(task)
    assert load_agent(tmp_path).task is task


OWN = replace(
    get_task("pendulum"),
    name="agent-io-limited",
    actuator=Actuator(lag=0.1),
    action_rate_limit=4.0,
    action_rate_cost=0.5,
    constraints=(
        Constraint("theta_dot", high=4.0, price=1.0),
        Constraint(
            "power", high=5.0, price=1.0, function=lambda s, action: s[..., 1] * action[..., 0]
        ),
    ),
)
"""A task with all the numbers that the settings of a run may change."""

CHANGES = {
    "actuator": Actuator(lag=0.2),
    "action_rate_limit": 2.0,
    "action_rate_cost": 0.25,
    "constraints": (replace(OWN.constraints[0], price=3.0), replace(OWN.constraints[1], high=6.0)),
}


@pytest.fixture
def own_task(monkeypatch):
    """The task is registered, for one test."""
    monkeypatch.setattr(registry._TASKS, "_entries", dict(registry._TASKS))
    monkeypatch.setattr(choices, "_OFFERED", dict(choices._OFFERED))
    return register_task(OWN)


@pytest.mark.parametrize("wanted", [None, OWN.name])
@pytest.mark.parametrize("changes", [*({k: v} for k, v in CHANGES.items()), {"constraints": ()}])
def test_a_task_that_is_found_by_name_has_the_numbers_of_the_training(
    changes, wanted, own_task, tmp_path, caplog
):
    trained = replace(own_task, **changes)
    save_agent(Agent(trained, actor=Actor(trained, (4,))), tmp_path)
    with caplog.at_level(logging.WARNING):
        assert load_agent(tmp_path, task=wanted).task == trained
    (record,) = caplog.records  # what is here gives way, and is not dropped without a word
    (name,) = changes
    told = [name, str(getattr(trained, name)), str(getattr(own_task, name))]
    assert all(each in record.getMessage() for each in told)
    caplog.clear()
    assert load_agent(tmp_path, task=trained).task is trained
    assert caplog.records == []


def test_numbers_of_the_training_that_the_task_lacks_or_shares_need_no_word(
    own_task, tmp_path, caplog
):
    save_agent(Agent(own_task, actor=Actor(own_task, (4,))), tmp_path / "same")
    pendulum = get_task("pendulum")
    trained = replace(pendulum, action_rate_limit=4.0, actuator=Actuator(lag=0.1))
    save_agent(Agent(trained, actor=Actor(trained, (4,))), tmp_path / "more")
    with caplog.at_level(logging.WARNING):
        assert load_agent(tmp_path / "same").task == own_task
        assert load_agent(tmp_path / "more").task == trained
    assert caplog.records == []


@pytest.mark.parametrize("name", CHANGES)
def test_a_task_that_is_given_is_refused_with_other_numbers(name, own_task, tmp_path):
    trained = replace(own_task, **{name: CHANGES[name]})
    save_agent(Agent(trained, actor=Actor(trained, (4,))), tmp_path)
    there, here = (re.escape(str(getattr(each, name))) for each in (trained, own_task))
    with pytest.raises(AgentError, match=f"expected its {name} {there}, got {here}"):
        load_agent(tmp_path, task=own_task)


def test_compiled_plans_are_the_same(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(torch, "compile", lambda function, **options: asked.append(1) or function)
    agent = make_agent()
    loaded = load_agent(save_agent(agent, tmp_path), compile=True)
    td = observations(agent, [2])
    assert torch.equal(act(agent, td), act(loaded, td))
    assert asked


# What can not be saved.


class OtherActor(nn.Module):
    def forward(self, observation):
        return observation[..., :1]


def test_foreign_parts_are_not_saved(tmp_path):
    task = get_task("pendulum")
    foreign = TensorDictModule(OtherActor(), ["observation"], ["action"])
    value = TensorDictModule(MLP(4, 1, 1, 4), ["observation", "action"], ["state_action_value"])
    own = HybridDynamics.pure_prior(task)
    nested = HybridDynamics(task, prior=nn.Sequential(PhysicsPrior(task.system)), residual=None)
    for part, options in [
        ("actor: expected a part that says how it is built .* OtherActor", {"actor": foreign}),
        ("qvalue: expected a part that says how it is built .* MLP", {"qvalue": value}),
        ("prior: expected a part that says how it is built .* Sequential", {"dynamics": nested}),
    ]:
        agent = make_agent(**{"dynamics": own, "config": None, **options})
        with pytest.raises(AgentError, match=part):
            save_agent(agent, tmp_path / "agent")
    agent = make_agent()
    agent.actor.module.mlp[0].weight.data[0, 0] = torch.inf
    with pytest.raises(AgentError, match=r"actor\.mlp\.0\.weight has non-finite"):
        save_agent(agent, tmp_path / "agent")
    for metadata in ({"seed": torch.tensor(1)}, {"return": float("nan")}):
        with pytest.raises(AgentError, match="metadata: expected JSON"):
            save_agent(make_agent(), tmp_path / "agent", metadata=metadata)
    assert not (tmp_path / "agent").exists()


class Unknown(SemiImplicitEuler):
    name = "unknown"


def test_an_unknown_solver_is_not_saved(tmp_path):
    """It could not be made again where the agent is loaded."""
    dynamics = HybridDynamics.pure_prior(get_task("pendulum"), integrator=Unknown())
    with pytest.raises(AgentError, match=r"saved: integrator: expected one of .* got 'unknown'"):
        save_agent(make_agent(dynamics=dynamics), tmp_path / "agent")
    assert not (tmp_path / "agent").exists()


def test_load_agent_is_public():
    assert "load_agent" in phihp_torchrl.__all__
