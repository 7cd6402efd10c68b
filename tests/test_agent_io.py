"""Agents: what they do, and that what is loaded is what was saved, or else a clear error."""

from __future__ import annotations

import hashlib
import json
import pickle
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP

import phihp_torchrl
from phihp_torchrl import HybridDynamics, get_task, load_agent, register_task
from phihp_torchrl.agents.networks import Actor, QNetwork, TwinQ, make_actor, make_twin_qvalue
from phihp_torchrl.agents.td3 import TD3Config, layers, make_td3_loss
from phihp_torchrl.deployment import Agent, AgentError, save_agent
from phihp_torchrl.dynamics import PhysicsPrior, ResidualMLP, TaskWorldModel
from phihp_torchrl.integrators import Dopri5
from phihp_torchrl.planners.factory import PlannerConfig, make_planner
from phihp_torchrl.tasks import list_tasks, registry

SMALL = PlannerConfig(
    planning_horizon=3, optim_steps=2, num_candidates=16, top_k=4, num_policy_candidates=4
)


def make_agent(name="pendulum", config=SMALL, **options):
    task = get_task(name)
    parts = {
        "dynamics": HybridDynamics.hybrid(task),
        "actor": Actor(task, (8, 8)),
        "qvalue": TwinQ(task, (8, 8)),
    }
    return Agent(task, **{**parts, "planner_config": config, **options})


def observations(agent, batch):
    task = agent.task
    observation = task.system.observe((task.coverage or task.reset).sample(batch))
    return TensorDict(observation=observation, batch_size=batch)


def act(agent, tensordict):
    torch.manual_seed(0)
    return agent(tensordict.clone())["action"]


# TwinQ


@pytest.mark.parametrize("batch", [[], [5], [2, 3]])
def test_twin_q_is_its_two_critics(batch):
    task = get_task("acrobot")
    loss = make_td3_loss(
        TaskWorldModel(task, HybridDynamics.oracle(task)),
        TD3Config(actor_hidden_sizes=(8,), critic_hidden_sizes=(8, 6)),
    )
    twin = TwinQ.from_layers(task, layers(loss.qvalue_network_params))
    observation, action = torch.randn(*batch, 6), torch.rand(*batch, 1)
    values = twin(observation, action)
    assert values.shape == (*batch, 2)
    for i in range(2):
        critic = QNetwork(task, (8, 6))
        columns = layers(loss.qvalue_network_params)
        for parameter, layer in zip(critic.mlp.parameters(), columns, strict=True):
            parameter.data.copy_(layer[i])
        torch.testing.assert_close(values[..., i], critic(observation, action).squeeze(-1))
    actor = Actor.from_layers(task, layers(loss.actor_network_params))
    td = TensorDict(observation=observation, batch_size=batch)
    with loss.actor_network_params.to_module(loss.actor_network):
        torch.testing.assert_close(actor(observation), loss.actor_network(td)["action"])


def test_layers_are_copied_and_must_fit():
    task = get_task("pendulum")
    source = [parameter.detach() for parameter in TwinQ(task, (4,)).layers]
    twin = TwinQ.from_layers(task, source)
    source[0].zero_()
    assert twin.layers[0].abs().sum() > 0
    with pytest.raises(ValueError, match="layers: expected shape"):
        TwinQ.from_layers(get_task("acrobot"), source)
    again = TwinQ(task, (4,))
    again.load_state_dict(twin.state_dict())
    td = TensorDict(observation=torch.randn(3, 3), action=torch.randn(3, 1), batch_size=[3])
    shell = make_twin_qvalue(task, (4,))
    shell.module.load_state_dict(twin.state_dict())
    expected = twin(td["observation"], td["action"])
    assert torch.equal(again(td["observation"], td["action"]), expected)
    assert torch.equal(shell(td)["state_action_value"], expected)


# The planner's configuration


def test_planner_gets_every_setting():
    config = PlannerConfig(
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
    task = get_task("pendulum")
    model = TaskWorldModel(task, HybridDynamics.oracle(task))
    before = torch.get_rng_state()
    planner = make_planner(model, make_actor(task, (4,)), None, config)
    assert not torch.equal(before, torch.get_rng_state()), "the actor draws its weights"
    before = torch.get_rng_state()
    make_planner(model, None, None, replace(config, num_policy_candidates=0))
    assert torch.equal(before, torch.get_rng_state()), "a planner draws nothing until it plans"
    for name in ("planning_horizon", "alpha", "gamma", "num_kept_elites", "select", "top_k"):
        assert getattr(planner.settings, name) == getattr(config, name)
    assert (planner.memory.replan_every, planner.memory.warm_start) == (2, True)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("planning_horizon", 0),
        ("num_candidates", -1),
        ("top_k", 221),
        ("replan_every", 6),
        ("replan_every", 1.5),
        ("warm_start", 1),
        ("select", "worst"),
    ],
)
def test_bad_planner_settings_are_named(key, value):
    with pytest.raises(ValueError, match=f"^{key}: expected"):
        PlannerConfig(**{key: value})


# The agent


@pytest.mark.parametrize("batch", [[], [5], [2, 3]])
@pytest.mark.parametrize("name", ["pendulum", "acrobot-swingup"])
def test_actions_in_bounds_for_any_batch(name, batch):
    agent = make_agent(name)
    td = observations(agent, batch)
    for policy in (agent, agent.actor_alone()):
        action = policy(td.clone())["action"]
        assert action.shape == (*batch, agent.task.system.action_dim)
        assert (action.abs() <= torch.tensor(agent.task.action_high)).all()
        assert not action.requires_grad


def test_the_actor_alone_is_the_actor():
    agent = make_agent()
    td = observations(agent, [4])
    alone = agent.actor_alone()
    assert alone.planner is None
    assert alone.planner_config == SMALL
    assert torch.equal(act(alone, td), agent.actor.module(td["observation"]))
    assert not torch.equal(act(agent, td), act(alone, td))
    with torch.no_grad():
        agent.actor.module.mlp[-1].bias.add_(1.0)
    assert torch.equal(act(alone, td), agent.actor.module(td["observation"])), "parts are shared"


def test_an_agent_forgets_its_plan_on_reset():
    agent = make_agent(config=replace(SMALL, replan_every=3))
    td = observations(agent, [2])
    agent(td.clone())
    assert agent.planner.memory._plans is not None
    agent.reset()
    assert agent.planner.memory._plans is None
    agent.actor_alone().reset()


def test_an_agent_needs_enough_parts():
    task = get_task("pendulum")
    with pytest.raises(ValueError, match="actor: expected"):
        Agent(task)
    with pytest.raises(ValueError, match="dynamics: expected a model"):
        Agent(task, actor=Actor(task, (4,)), planner_config=SMALL)
    with pytest.raises(ValueError, match="actor: expected a module"):
        Agent(task, dynamics=HybridDynamics.oracle(task), planner_config=SMALL)
    plain = Agent(
        task,
        dynamics=HybridDynamics.oracle(task),
        planner_config=replace(SMALL, num_policy_candidates=0),
    )
    assert plain(observations(plain, [2]))["action"].shape == (2, 1)


@pytest.mark.parametrize("planner", [True, False])
def test_bad_observations_are_named(planner):
    agent = make_agent() if planner else make_agent().actor_alone()
    for bad in (
        torch.zeros(3, 2),
        torch.zeros(3, 3, dtype=torch.float64),
        torch.zeros(3, 3, device="meta"),
        torch.full((3, 3), torch.nan),
    ):
        with pytest.raises(ValueError, match=r"^observation: expected"):
            agent(TensorDict({"observation": bad}, batch_size=[3]))
    with pytest.raises(ValueError, match="observation: expected"):
        agent(TensorDict(batch_size=[3]))


# Saving and loading


def kinds(task):
    return {
        "hybrid": HybridDynamics.hybrid(task, hidden_sizes=(5, 6, 7), constants={}),
        "all outputs": HybridDynamics.hybrid(task, residual_outputs="all", integrator="rk4"),
        "data-driven": HybridDynamics.data_driven(task, hidden_sizes=(4,)),
        "pure prior": HybridDynamics.pure_prior(task),
        "oracle": HybridDynamics.oracle(task),
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


def test_partial_agents(tmp_path):
    task = get_task("pendulum")
    actor = Agent(task, actor=Actor(task, ()))
    loaded = load_agent(save_agent(actor, tmp_path / "actor"))
    td = observations(actor, [3])
    assert torch.equal(act(actor, td), act(loaded, td))
    cem = make_agent(
        actor=None, qvalue=None, config=replace(SMALL, num_policy_candidates=0, warm_start=True)
    )
    loaded = load_agent(save_agent(cem, tmp_path / "cem"))
    assert torch.equal(act(cem, td), act(loaded, td))
    with pytest.raises(AgentError, match="actor: expected one"):
        load_agent(tmp_path / "cem", planner=False)


def test_the_papers_sizes_stay_under_two_megabytes(tmp_path):
    for name in ("pendulum-swingup", "acrobot-swingup"):
        task = get_task(name)
        agent = make_agent(name, actor=Actor(task), qvalue=TwinQ(task), config=PlannerConfig())
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
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    task = replace(get_task("pendulum"), name="agent-io-pendulum", env_id=None)
    save_agent(Agent(task, actor=Actor(task, (4,))), tmp_path)
    with pytest.raises(AgentError, match=r"expected one of .*'acrobot'.* got 'agent-io-pendulum'"):
        load_agent(tmp_path)
    assert load_agent(tmp_path, task=task).task is task
    assert load_agent(tmp_path, task=replace(task, max_steps=7)).task.max_steps == 7
    with pytest.raises(AgentError, match=r"another one here: expected its time_step 0.1, got 0.05"):
        load_agent(tmp_path, task=replace(task, time_step=0.1))
    register_task(task)
    assert load_agent(tmp_path).task is task


def test_compiled_plans_are_the_same(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(torch, "compile", lambda function, **options: asked.append(1) or function)
    agent = make_agent()
    loaded = load_agent(save_agent(agent, tmp_path), compile=True)
    td = observations(agent, [2])
    assert torch.equal(act(agent, td), act(loaded, td))
    assert asked


# What can not be saved


class OtherActor(nn.Module):
    def forward(self, observation):
        return observation[..., :1]


def test_foreign_parts_are_not_saved(tmp_path):
    task = get_task("pendulum")
    foreign = TensorDictModule(OtherActor(), ["observation"], ["action"])
    value = TensorDictModule(MLP(4, 1, 1, 4), ["observation", "action"], ["state_action_value"])
    own = HybridDynamics.pure_prior(task)
    nested = HybridDynamics(task, prior=nn.Sequential(PhysicsPrior(task.system)), residual=None)
    fine = HybridDynamics.pure_prior(task, integrator=Dopri5(rtol=1e-3))
    for part, options in [
        ("actor: .* Actor, got OtherActor", {"actor": foreign}),
        ("qvalue: .* TwinQ, got MLP", {"qvalue": value}),
        ("prior: .* PhysicsPrior or None, got Sequential", {"dynamics": nested}),
        ("integrator: .* got Dopri5", {"dynamics": fine}),
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


# What can not be loaded


@pytest.fixture
def saved(tmp_path):
    return save_agent(make_agent(), tmp_path, metadata={"seed": 0})


def edit_json(directory, change):
    path = directory / "agent.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def edit_weights(directory, change):
    """A change whose checksum fits, so that the other checks have to see it."""
    path = directory / "weights.safetensors"
    weights = load_file(path)
    change(weights)
    save_file(weights, path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    edit_json(directory, lambda content: content.update(weights_sha256=digest))


def refused(directory, match, **options):
    with pytest.raises(AgentError, match=match) as error:
        load_agent(directory, **options)
    return str(error.value)


def test_missing_files(saved, tmp_path):
    assert "nowhere" in refused(tmp_path / "nowhere", "expected the directory of a saved agent")
    (saved / "weights.safetensors").rename(saved / "other")
    refused(saved, r"weights\.safetensors: expected this file")
    (saved / "agent.json").unlink()
    refused(saved, r"agent\.json: expected this file")
    refused(saved / "other", "expected the directory")


def test_other_tasks_and_versions(saved):
    refused(saved, "expected an agent for task 'acrobot', got one for 'pendulum'", task="acrobot")
    refused(saved, "expected an agent for task", task=get_task("acrobot"))
    refused(saved, "device: expected one that works", device="no-such-device")
    edit_json(saved, lambda c: c["task"].update(name="pendulum-swing-up"))
    refused(saved, "expected one of .*'pendulum-swingup'.* got 'pendulum-swing-up'")
    edit_json(saved, lambda c: c.update(format_version=2))
    refused(saved, "expected format_version 1, got 2")
    edit_json(saved, lambda c: c.update(format="soup"))
    refused(saved, "expected format 'phihp_torchrl agent', got 'soup'")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (b"", "expected JSON"),
        (b"{", "expected JSON"),
        (b"\xff\xfe\x00", "expected JSON"),
        (b"[" * 100_000, "expected JSON"),
        (b'{"format": NaN}', "NaN is not a number"),
        (b"[1]", "expected a JSON object, got list"),
        (b" " * 1_000_001, "expected at most 1000000 bytes"),
        (pickle.dumps({"format": 1}), "expected JSON"),
    ],
)
def test_what_is_not_json(saved, text, match):
    (saved / "agent.json").write_bytes(text)
    refused(saved, match)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda c: c.pop("dynamics"), "expected the key 'dynamics'"),
        (lambda c: c.update(metadata=3), "metadata: expected a JSON object"),
        (lambda c: c.update(task="pendulum"), "task: expected an object"),
        (lambda c: c["task"].update(name=["pendulum"]), r"task\.name: expected a text"),
        (lambda c: c["task"].update(action_high=[3.0]), r"expected its action_high \(2.0,\)"),
        (lambda c: c["dynamics"].update(prior="soup"), r"prior: expected .* got 'soup'"),
        (lambda c: c["dynamics"].update(integrator="euler"), "integrator: expected one of"),
        (lambda c: c["dynamics"].pop("integrator"), "dynamics: expected the keys"),
        (lambda c: c["dynamics"].update(prior=None, residual=None), "expected at least one"),
        (lambda c: c["dynamics"]["residual"].update(outputs=[7]), "residual.outputs: expected"),
        (lambda c: c["dynamics"]["residual"].update(activation="eval"), "activation: expected one"),
        (lambda c: c["dynamics"]["residual"].update(hidden_sizes=[0]), "hidden_sizes: expected"),
        (lambda c: c.update(actor_hidden_sizes=[10**12]), "actor_hidden_sizes: expected"),
        (lambda c: c.update(actor_hidden_sizes=[4] * 100), "actor_hidden_sizes: expected"),
        (lambda c: c.update(actor_hidden_sizes=["8"]), "actor_hidden_sizes: expected"),
        (lambda c: c.update(actor_hidden_sizes=8), "agent: "),
        (lambda c: c["planner"].update(top_k=17), "top_k: expected at most num_candidates=16"),
        (lambda c: c["planner"].update(horizon=3), "planner: expected the keys"),
        (lambda c: c["planner"].update(alpha="1"), "planner: "),
        (lambda c: c.update(weights_sha256="0"), "expected the weights that agent.json was"),
    ],
)
def test_bad_descriptions_are_named(saved, change, match):
    edit_json(saved, change)
    assert str(saved) in refused(saved, match)


def test_a_setting_that_came_later_has_its_default(saved):
    edit_json(saved, lambda c: c["planner"].pop("actor_margin"))
    assert load_agent(saved).planner_config == SMALL


def test_huge_sizes_take_no_memory(saved):
    edit_json(saved, lambda c: c.update(actor_hidden_sizes=[65_536] * 30))
    refused(saved, "missing .*actor.mlp.10.weight")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda w: w.pop("actor.mlp.0.bias"), r"missing \['actor.mlp.0.bias'\], not expected \[\]"),
        (lambda w: w.update(soup=torch.ones(1)), r"missing \[\], not expected \['soup'\]"),
        (
            lambda w: w.update({"actor.mlp.0.bias": torch.zeros(9)}),
            r"actor.mlp.0.bias: expected torch.float32 of shape \[8\], got .*\[9\]",
        ),
        (
            lambda w: w.update({"actor.mlp.0.bias": torch.zeros(8, dtype=torch.float64)}),
            "actor.mlp.0.bias: expected torch.float32",
        ),
        (lambda w: w["qvalue.layers.1"].fill_(torch.nan), "qvalue.layers.1: expected finite"),
        (lambda w: w["actor.action_high"].fill_(99.0), r"actor.action_high: expected the task's"),
    ],
)
def test_weights_that_do_not_fit(saved, change, match):
    edit_weights(saved, change)
    assert "weights.safetensors" in refused(saved, match)


def test_damaged_weights(saved):
    path = saved / "weights.safetensors"
    data = path.read_bytes()

    class Bomb:
        def __reduce__(self):
            return pytest.fail, ("code in the file was run",)

    hostile = [
        b"",
        data[:-1],
        data[:100],
        data[:4],
        data + b"\0",
        b"\xff" * 8 + data[8:],
        (2**40).to_bytes(8, "little") + data[8:],
        pickle.dumps(Bomb()),
    ]
    for payload in hostile:
        path.write_bytes(payload)
        refused(saved, r"weights\.safetensors: expected about \d+ bytes of safetensors")
    path.write_bytes(data + b"\0" * 200_000)
    refused(saved, "expected at most .* bytes, got 2")
    flipped = bytearray(data)
    flipped[-5] ^= 1
    path.write_bytes(flipped)
    refused(saved, "expected the weights that agent.json was written with")
    path.write_bytes(data)
    load_agent(saved)


def test_load_agent_is_public():
    assert "load_agent" in phihp_torchrl.__all__
