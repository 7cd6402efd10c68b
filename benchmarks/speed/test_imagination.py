"""Imagined transitions against TorchRL's rollouts in the same model."""

from __future__ import annotations

import pytest
import torch
from race import forward, products, race
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule

from phihp_torchrl import HybridDynamics, WorldModelEnv, get_task, load_agent
from phihp_torchrl.agents import Actor, act
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Returns, Rollouts, Worlds, draw_noise, sum_rewards

AGENT, STEPS = "results/agents/pendulum-swingup", 200


@pytest.mark.parametrize(("worlds", "steps"), [(64, 4), (1, 2)])
def test_transitions(benchmark, report, worlds, steps):
    task = get_task("pendulum-swingup")
    model = TaskWorldModel(task, HybridDynamics.hybrid(task)).requires_grad_(False)
    actor = Actor(task)
    layers = [p.detach() for p in actor.mlp.parameters()]
    places = Worlds(task.reset.sample([worlds]), torch.zeros(worlds, dtype=torch.int64))

    def imagines(compile):
        rollouts = Rollouts(model, act, task.max_steps, compile=compile)

        def call():
            starts = task.coverage.sample([steps, worlds])
            noise = draw_noise(starts, task.bounds, std=0.1, random_fraction=0.1)
            rollouts.chunk(layers, places, noise)

        return call

    env = WorldModelEnv(model, batch_size=[worlds])
    policy = TensorDictModule(actor, ["observation"], ["action"])
    noisy = TensorDictSequential(
        policy, AdditiveGaussianModule(env.action_spec, sigma_init=0.1, sigma_end=0.1)
    )
    length = 50 * steps  # long enough for the reset not to count

    def explore(length):
        with set_exploration_type(ExplorationType.RANDOM):
            env.rollout(length, noisy, break_when_any_done=False)

    sizes = [env.observation_spec["observation"].shape[-1], 300, 300, 1]
    times = race(
        benchmark,
        {
            "chunk, compiled": imagines(True),
            "chunk, eager": imagines(False),
            "env.rollout": lambda: env.rollout(length, policy, break_when_any_done=False),
            "env.rollout, noisy": lambda: explore(length),
            "the actor's products": products(steps * forward(worlds, sizes)),
        },
        rounds=30,
    )
    for name in ("env.rollout", "env.rollout, noisy"):
        times[name] = [t * steps / length for t in times[name]]
    note = (
        f"{worlds} worlds of PendulumSwingup, noisy actor of 2 x 300, the time is for one step of "
        f"all of them: {steps} to a chunk, noise and starts drawn anew; `env.rollout` goes "
        f"{length} steps, without noise or with TorchRL's. The last row is `torch.mm` on the "
        "actor's shapes."
    )
    report(f"Imagined steps of {worlds} worlds", times, note, work=steps)


def test_returns(benchmark, report):
    agent = load_agent(AGENT)
    task = agent.task
    rollouts = Rollouts(TaskWorldModel(task, agent.dynamics), act, max_age=task.max_steps)
    weights = [layer.detach() for layer in agent.actor.module.mlp.parameters()]
    states = task.reset.sample([64])

    def one_by_one():
        start = Returns.from_state(states, task.bounds)
        model = rollouts.world_model.prepared()
        return sum_rewards(model, act, weights, start, task.bounds, STEPS)

    times = race(
        benchmark,
        {
            "rewards of all steps together": lambda: rollouts.returns(weights, states, STEPS),
            "one step after the other": one_by_one,
        },
        rounds=20,
    )
    note = f"PendulumSwingup, the actor's returns of {STEPS} steps from 64 states, eager."
    ratios = report("Returns of an actor in imagination", times, note)
    assert ratios["one step after the other"] > 1
