"""On CUDA: every part of the way gives there what it gives on the CPU, and leaves its data there.

Skipped on a machine without such a device.
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import (
    DynamicsLoss,
    HybridDynamics,
    WorldModelEnv,
    get_task,
    load_agent,
    save_agent,
)
from phihp_torchrl.agents import (
    Actor,
    CriticRefit,
    FlatReplay,
    RefitConfig,
    TD3Config,
    TD3Update,
    TwinQ,
    act,
    make_td3_loss,
)
from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import FitConfig, TaskWorldModel, fit
from phihp_torchrl.evaluation import evaluate
from phihp_torchrl.imagination import Batch, Rollouts, Worlds, draw_noise
from phihp_torchrl.planners import CEMConfig, MPPIConfig, make_planner

pytestmark = pytest.mark.cuda

TASKS = ["pendulum-swingup", "cartpole-swingup", "acrobot-swingup"]
SMALL = {"num_candidates": 16, "top_k": 4, "num_policy_candidates": 4, "planning_horizon": 3}


@pytest.fixture(autouse=True)
def full_precision():
    """Products of float32 as on the CPU, not in the shorter format of the matrix units."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    yield
    torch.set_float32_matmul_precision(before)


def make_model(name="pendulum-swingup", **changes):
    task = get_task(name).with_actuator(changes)
    return TaskWorldModel(task, HybridDynamics.hybrid(task)).requires_grad_(False)


def make_batch(model, rows):
    task = model.task
    state = task.at_rest(task.coverage.sample([rows]))
    action = task.bounds.from_unit(2 * torch.rand(rows, task.action_dim) - 1)
    next_state, reward, terminated = model.transition(state, action)
    return Batch(state, action, reward, next_state, terminated)


def moved(batch):
    return Batch(*(column.cuda() for column in batch))


def layers_of(actor):
    return [layer.detach() for layer in actor.mlp.parameters()]


def close(on_cuda, on_cpu, **tolerance):
    assert on_cuda.device.type == "cuda"
    torch.testing.assert_close(on_cuda.cpu(), on_cpu, **({"rtol": 1e-4, "atol": 1e-4} | tolerance))


@pytest.mark.parametrize("name", TASKS)
def test_a_step_of_the_task(name):
    model = make_model(name)
    batch = make_batch(model, 64)
    there = model.cuda().transition(batch.state.cuda(), batch.action.cuda())
    close(there[0], batch.next_state)
    close(there[1], batch.reward)
    assert torch.equal(there[2].cpu(), batch.terminated)


@pytest.mark.parametrize("path", [{"delay_steps": 1.5, "lag": 0.04}, {"slew": 3.0}])
def test_what_is_under_way(path):
    model = make_model("cartpole-swingup", **path)
    batch = make_batch(model, 64)
    there = model.cuda().transition(batch.state.cuda(), batch.action.cuda())
    close(there[0], batch.next_state)
    observation = model.observe(batch.state.cuda())
    close(model.task.locate(observation), batch.state)


@pytest.mark.parametrize("method", ["levenberg_marquardt", "adam"])
def test_a_fit(method):
    model = make_model("cartpole")
    batch = make_batch(model, 256)
    data = TensorDict(
        {
            "observation": model.observe(batch.state),
            "action": batch.action,
            ("next", "observation"): model.observe(batch.next_state),
        },
        batch_size=[256],
    ).cuda()
    task = model.task
    dynamics = HybridDynamics.hybrid(task).cuda()
    loss = DynamicsLoss(dynamics)
    report = fit(loss, data[:200], data[200:], FitConfig(method=method, steps=20))
    assert report.held_out_error >= 0.0
    assert {p.device.type for p in dynamics.parameters()} == {"cuda"}
    assert all(p.isfinite().all() for p in dynamics.parameters())


@pytest.mark.parametrize("compile", [False, True])
def test_imagined_worlds(compile):
    model = make_model("cartpole-swingup")
    task, steps, count = model.task, 3, 32
    weights = layers_of(Actor(task))
    starts = task.coverage.sample([steps, count])
    noise = draw_noise(starts, task.bounds, std=0.1, random_fraction=0.2)
    worlds = Worlds(task.coverage.sample([count]), torch.zeros(count, dtype=torch.int64))
    expected, _ = Rollouts(model, act, task.max_steps).chunk(weights, worlds, noise)
    rollouts = Rollouts(model.cuda(), act, task.max_steps, device="cuda", compile=compile)
    there, after = rollouts.chunk(
        [weight.cuda() for weight in weights],
        worlds.to("cuda"),
        noise.to("cuda"),
    )
    close(there.next_state, expected.next_state)
    assert after.age.device.type == "cuda"


@pytest.mark.parametrize("compile", [False, True])
def test_a_td3_update(compile):
    model = make_model("cartpole-swingup")
    config = TD3Config(target_noise=0.0)
    here = TD3Update(make_td3_loss(model, config), model, config)
    batch = make_batch(model, 64)
    saved = {name: value.clone() for name, value in here.state_dict().items()}
    expected = here(batch)
    model = model.cuda()
    there = TD3Update(make_td3_loss(model, config), model, config, compile=compile).cuda()
    there.load_state_dict(saved)
    for key, value in there(moved(batch)).items():
        close(value, expected[key], rtol=1e-3)
    for layer, other in zip(there.actor, here.actor, strict=True):
        close(layer, other)


def test_replay_and_refit():
    model = make_model().cuda()
    replay = FlatReplay(100, model.task.state_dim, model.task.action_dim).cuda()
    replay.extend(moved(make_batch(make_model(), 64)))
    batch = replay.sample(32)
    assert batch.state.device.type == "cuda"
    config = TD3Config()
    update = TD3Update(make_td3_loss(model, config), model, config).cuda()
    rollouts = Rollouts(model, act, 10, device="cuda")
    refit = CriticRefit(model, rollouts, RefitConfig(transitions=32, horizon=3, steps=2), 0.99)
    fitted = refit(update.actor, update.critics, batch.state, batch.action)
    assert all(layer.is_cuda and layer.isfinite().all() for layer in fitted.critics)


@pytest.mark.parametrize("config", [CEMConfig(**SMALL), MPPIConfig(**SMALL)], ids=["cem", "mppi"])
@pytest.mark.parametrize("batch", [[], [5]])
def test_a_plan(config, batch):
    task = get_task("cartpole-swingup")
    observation = task.observe(task.coverage.sample(batch)).cuda()
    action = make_agent(task, config)(TensorDict(observation=observation, batch_size=batch))
    action = action["action"]
    assert action.shape == (*batch, 1)
    assert action.is_cuda
    assert bool(task.bounds.to("cuda").clip(action).eq(action).all())


def test_a_compiled_plan():
    model = make_model().cuda()
    config = CEMConfig(**{**SMALL, "num_policy_candidates": 0})
    planner = make_planner(model, None, None, config, compile=True)
    data = TensorDict(observation=model.observe(model.task.coverage.sample([]).cuda()))
    assert planner(data)["action"].is_cuda


def make_agent(task, config):
    return Agent(
        task,
        dynamics=HybridDynamics.hybrid(task).cuda(),
        actor=Actor(task).cuda(),
        qvalue=TwinQ(task).cuda(),
        planner_config=config,
    ).cuda()


def test_an_agent_moves_between_devices(tmp_path):
    task = get_task("pendulum-swingup")
    agent = make_agent(task, CEMConfig(**SMALL))
    save_agent(agent, tmp_path / "agent")
    there = load_agent(tmp_path / "agent", device="cuda", planner=False)
    here = load_agent(tmp_path / "agent", planner=False)
    observation = task.observe(task.coverage.sample([7]))
    close(
        there(TensorDict(observation=observation.cuda(), batch_size=[7]))["action"],
        here(TensorDict(observation=observation, batch_size=[7]))["action"],
    )


def test_an_agent_keeps_what_is_under_way_on_its_device():
    model = make_model("pendulum-swingup", delay_steps=2)
    task = model.task
    agent = Agent(task, actor=Actor(task).cuda()).cuda()
    observation = task.system.observe(task.reset.sample([3])).cuda()
    for start in (True, False):
        data = TensorDict(observation=observation, batch_size=[3], device="cuda")
        data["is_init"] = torch.full([3, 1], start, device="cuda")
        assert agent(data)["action"].is_cuda


def test_an_evaluation_starts_from_the_same_states():
    task = get_task("pendulum")
    actor = Actor(task)
    here = evaluate(Agent(task, actor=actor), task, episodes=4)
    there = evaluate(Agent(task, actor=actor.cuda()).cuda(), task, episodes=4, device="cuda")
    torch.testing.assert_close(there.returns, here.returns, rtol=1e-2, atol=0.5)


def test_the_environment_of_a_model():
    model = make_model().cuda()
    env = WorldModelEnv(model, batch_size=[4], seed=0)
    rollout = env.rollout(5)
    assert rollout["next", "reward"].is_cuda
    assert rollout["next", "observation"].isfinite().all()
