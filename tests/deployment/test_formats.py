"""Agents that were written in the first format are read, act as ever, and are written anew."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from phihp_torchrl import HybridDynamics, evaluate, get_task, load_agent, save_agent
from phihp_torchrl.deployment.formats import FORMAT_VERSION, TaskSignature, upgrade
from phihp_torchrl.evaluation import evaluation_seed
from phihp_torchrl.planners import MPPIConfig
from phihp_torchrl.tdmpc import TOLD, TDMPCAgent, TOLDConfig
from phihp_torchrl.worlds import SimulatedWorld

from .agent_parts import SMALL, act, edit_json, make_agent, observations, refused

AGENTS = Path(__file__).parents[2] / "results" / "agents"
TASKS = ["acrobot", "acrobot-swingup", "cartpole", "cartpole-swingup", "pendulum"]
TASKS += ["pendulum-swingup"]
KEPT = {name: AGENTS / name for name in TASKS}
KEPT["0.1.0"] = Path(__file__).parent / "agent_of_0_1_0"  # of pendulum-swingup, in version 1
MPPI = MPPIConfig(
    planning_horizon=3, optim_steps=2, num_candidates=16, top_k=4, num_policy_candidates=4
)


def read(directory):
    return json.loads((Path(directory) / "agent.json").read_text())


# The agents of this repository, and one that version 0.1.0 saved.


def test_all_of_them_are_here():
    assert sorted(path.name for path in AGENTS.iterdir() if path.is_dir()) == TASKS


@pytest.mark.parametrize("name", KEPT)
def test_kept_agents_load_act_and_are_saved_in_this_format(name, tmp_path):
    old, task = read(KEPT[name]), name.replace("0.1.0", "pendulum-swingup")
    assert old["format_version"] in (1, FORMAT_VERSION)
    agent = load_agent(KEPT[name], task=task, planner=True)
    td, bounds = observations(agent, [20]), agent.task.bounds
    action = act(agent, td)
    assert (action >= bounds.low).all()
    assert (action <= bounds.high).all()
    assert action.std() > 0
    assert agent.metadata == old["metadata"]
    new = read(save_agent(agent, tmp_path))
    assert new["format_version"] == FORMAT_VERSION
    assert new["kind"] == "phihp"
    assert new["task"] == json.loads(json.dumps(asdict(TaskSignature.of(agent.task))))
    assert new["metadata"] == old["metadata"]
    for name_, value in old["planner"].items():
        assert new["planner"][name_] == value
    loaded = load_agent(tmp_path, planner=True)
    assert torch.equal(act(loaded, td), action)
    assert torch.equal(act(loaded.actor_alone(), td), act(agent.actor_alone(), td))


@pytest.mark.parametrize("name", KEPT)
def test_their_actors_earn_what_they_earned(name):
    """The episodes that were recorded with them, one by one."""
    recorded = json.loads((KEPT[name] / "evaluation.json").read_text())["actor"]
    actor = load_agent(KEPT[name], planner=False)
    result = evaluate(actor, actor.task, episodes=50, seed=evaluation_seed())
    expected = torch.tensor(recorded["returns"], dtype=torch.float64)
    assert result.mean == pytest.approx(recorded["return_mean"], rel=0.02)
    # A rounding error grows on the way, in a few episodes to another swing.
    close = (result.returns - expected).abs() <= 1e-3 * (1 + expected.abs())
    assert close.float().mean() > 0.9


# Agents of every kind, as the first format wrote them.


def as_version_1(directory, action_high):
    """Rewrite a saved agent as the first format would have, weights included."""
    path = Path(directory) / "weights.safetensors"
    weights, content = load_file(path), read(directory)
    owners = {name.partition(".")[0] for name in weights} - {"dynamics"}
    save_file({**weights, **{f"{o}.action_high": action_high.clone() for o in owners}}, path)
    task = {key: value for key, value in content["task"].items() if key != "action_low"}
    planner = content["planner"]
    if planner is not None:
        planner = {key: value for key, value in planner.items() if key != "kind"}
    old = {
        "format": content["format"],
        "format_version": 1,
        "package_version": "0.1.0",
        "task": task,
    }
    if content["kind"] == "td-mpc":
        old |= {"told": content["networks"]}
    else:
        dynamics = content.get("dynamics")
        if dynamics is not None:
            kind = dynamics["prior"] and dynamics["prior"]["kind"]
            dynamics = {
                "prior": {"learned": "learned", "plant": "world", None: None}[kind],
                "residual": dynamics["residual"],
                "integrator": dynamics["integrator"]["name"],
            }
        old |= {"dynamics": dynamics}
        for key, part in (("actor_hidden_sizes", "actor"), ("critic_hidden_sizes", "qvalue")):
            old |= {key: content[part]["hidden_sizes"] if part in content else None}
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    old |= {"planner": planner, "weights_sha256": digest, "metadata": content["metadata"]}
    (Path(directory) / "agent.json").write_text(json.dumps(old))


def td_mpc(task="cartpole", planner=MPPI):
    task = get_task(task)
    sizes = TOLDConfig(latent_dim=4, encoder_dim=8, mlp_dim=12)
    return TDMPCAgent(task, TOLD.for_task(task, sizes), planner, metadata={"seed": 3})


PLAIN = replace(SMALL, num_policy_candidates=0)
KINDS = {
    "PhIHP": lambda: make_agent(),
    "data-driven": lambda: make_agent(dynamics=HybridDynamics.data_driven(get_task("pendulum"))),
    "pure prior": lambda: make_agent(dynamics=HybridDynamics.pure_prior(get_task("pendulum"))),
    "rk4": lambda: make_agent(
        dynamics=HybridDynamics.hybrid(get_task("pendulum"), integrator="rk4")
    ),
    "dopri5": lambda: make_agent(
        dynamics=HybridDynamics.hybrid(get_task("pendulum"), integrator="dopri5")
    ),
    "two actions": lambda: make_agent("acrobot-swingup"),
    "TD3": lambda: make_agent(dynamics=None, config=None),
    "CEM": lambda: make_agent(actor=None, qvalue=None, config=PLAIN),
    "CEM-oracle": lambda: make_agent(
        "cartpole",
        actor=None,
        qvalue=None,
        config=PLAIN,
        dynamics=SimulatedWorld("cartpole").oracle(),
    ),
    "TD-MPC": td_mpc,
    "TD-MPC without terminations": lambda: td_mpc("pendulum-swingup"),
    "TD-MPC's policy": lambda: td_mpc(planner=None),
}


@pytest.mark.parametrize("name", KINDS)
def test_version_1_of_every_kind_acts_as_it_did(name, tmp_path):
    agent = KINDS[name]()
    save_agent(agent, tmp_path / "one")
    expected = read(tmp_path / "one")
    as_version_1(tmp_path / "one", agent.task.bounds.high)
    assert read(tmp_path / "one")["format_version"] == 1
    loaded = load_agent(tmp_path / "one", task=agent.task)
    assert type(loaded) is type(agent)
    assert loaded.planner_config == agent.planner_config
    td = observations(agent, [5])
    assert torch.equal(act(loaded, td), act(agent, td))
    # What was read of version 1 is written as if it had been saved today.
    assert read(save_agent(loaded, tmp_path / "two")) == expected
    assert torch.equal(act(load_agent(tmp_path / "two"), td), act(agent, td))


def test_an_old_td_mpc_file_word_for_word(tmp_path):
    """As it lay on disk, its schema written out by hand."""
    agent = td_mpc()
    save_agent(agent, tmp_path)
    weights = load_file(tmp_path / "weights.safetensors")
    weights["told.action_high"] = torch.tensor([10.0])
    save_file(weights, tmp_path / "weights.safetensors")
    digest = hashlib.sha256((tmp_path / "weights.safetensors").read_bytes()).hexdigest()
    content = {
        "format": "phihp_torchrl agent",
        "format_version": 1,
        "package_version": "0.1.0",
        "task": {
            "name": "cartpole",
            "state_names": ["x", "x_dot", "theta", "theta_dot"],
            "action_names": ["force"],
            "constants": ["gravity", "cart_mass", "pole_mass", "half_length"],
            "action_high": [10.0],
            "time_step": 0.02,
        },
        "told": {"latent_dim": 4, "encoder_dim": 8, "mlp_dim": 12},
        "planner": {
            "planning_horizon": 3,
            "optim_steps": 2,
            "num_candidates": 16,
            "top_k": 4,
            "num_policy_candidates": 4,
            "policy_noise": 0.05,
            "policy_noise_clip": 0.3,
            "alpha": 1.0,
            "gamma": 0.99,
            "init_std": 2.0,
            "min_std": 0.05,
            "tail_dtype": "float32",
            "temperature": 0.5,
            "momentum": 0.1,
            "select": "sample",
        },
        "weights_sha256": digest,
        "metadata": {"seed": 3},
    }
    (tmp_path / "agent.json").write_text(json.dumps(content))
    loaded = load_agent(tmp_path, task="cartpole")
    assert isinstance(loaded, TDMPCAgent)
    assert loaded.planner_config == MPPI
    assert loaded.metadata == {"seed": 3}
    td = observations(agent, [5])
    assert torch.equal(act(loaded, td), act(agent, td))


@pytest.mark.parametrize("name", ["tail_dtype", "actor_margin"])
def test_settings_that_version_1_did_not_have_change_nothing(name, tmp_path):
    agent = make_agent()
    save_agent(agent, tmp_path)
    as_version_1(tmp_path, agent.task.bounds.high)
    edit_json(tmp_path, lambda content: content["planner"].pop(name))
    assert load_agent(tmp_path).planner_config == SMALL


def test_this_format_stays_as_it_is():
    content = {"format_version": FORMAT_VERSION, "kind": "phihp", "told": 1, "planner": None}
    assert upgrade(content) == content


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda c: c.pop("dynamics"), "expected the key 'dynamics'"),
        (lambda c: c.pop("actor_hidden_sizes"), "expected the key 'actor_hidden_sizes'"),
        (lambda c: c.pop("planner"), "expected the key 'planner'"),
        (lambda c: c["task"].pop("action_high"), "expected the key 'action_high'"),
        (lambda c: c.update(task="pendulum"), r"agent\.json: "),
        (
            lambda c: c["dynamics"].update(prior="soup"),
            r"dynamics\.prior: expected one of \['learned', 'world', None\], got 'soup'",
        ),
        (lambda c: c["dynamics"].update(prior=["world"]), r"agent\.json: "),
        (lambda c: c["dynamics"].update(integrator="euler"), "integrator: expected one of"),
        (lambda c: c["dynamics"].pop("residual"), "expected the key 'residual'"),
        (lambda c: c.update(actor_hidden_sizes=[10**12]), "hidden_sizes: expected 1 to 32 widths"),
        (lambda c: c.update(critic_hidden_sizes=8), r"agent\.json: "),
        (lambda c: c["planner"].update(horizon=3), r"planner\.horizon: unknown key"),
        (lambda c: c.update(planner="cem"), r"agent\.json: "),
        (lambda c: c.update(dynamics=3), r"agent\.json: "),
    ],
)
def test_bad_descriptions_of_version_1_are_named(tmp_path, change, match):
    agent = make_agent()
    save_agent(agent, tmp_path)
    as_version_1(tmp_path, agent.task.bounds.high)
    edit_json(tmp_path, change)
    assert str(tmp_path) in refused(tmp_path, match)
