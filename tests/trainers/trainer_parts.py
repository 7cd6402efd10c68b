"""Small phases on the pendulum, and states compared bit by bit."""

from __future__ import annotations

from dataclasses import replace

import torch

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import RefitConfig, TD3Config
from phihp_torchrl.dynamics import FitConfig
from phihp_torchrl.imagination import Batch
from phihp_torchrl.trainers import (
    CollectConfig,
    ModelConfig,
    PolicyConfig,
    PolicyTrainer,
    RealTD3Config,
)

PENDULUM = get_task("pendulum")
SHORT = replace(PENDULUM, name="short-pendulum", max_steps=15)
COLLECT = CollectConfig(
    planning_horizon=5, replan_every=5, num_candidates=8, top_k=2, optim_steps=1
)
MODEL = ModelConfig(
    real_steps=70,
    steps_per_iteration=25,
    hidden_sizes=(4,),
    integrator="semi_implicit_euler",  # the choice of one has tests of its own, and fits five
    fit=FitConfig(steps=2, batch_size=16),
    collect=COLLECT,
)
ADAM = replace(MODEL, fit=FitConfig(method="adam", steps=3, batch_size=16))
POLICY = PolicyConfig(
    updates=12,
    batch_size=8,
    num_worlds=4,
    chunk_steps=2,
    updates_per_step=2,
    replay_capacity=64,
    random_steps=16,
    max_age=5,
    evaluation_interval=4,
    evaluation_episodes=4,
    evaluation_steps=5,
    real_evaluation_episodes=2,
    patience=0.0,
    td3=TD3Config(
        actor_hidden_sizes=(8, 8),
        critic_hidden_sizes=(8, 8),
        actor_learning_rate=1e-3,
        critic_learning_rate=1e-4,
        last_layer_scale=1.0,
    ),
    refit=RefitConfig(interval=0),
)
REAL = RealTD3Config(
    real_steps=60,
    batch_size=8,
    random_steps=20,
    steps_per_update=1,
    decay=0.0,
    evaluation_interval=20,
    evaluation_episodes=2,
    actor_hidden_sizes=(8,),
    critic_hidden_sizes=(8,),
)


def policy_trainer(config=POLICY, seed=0, dynamics=None, **options):
    torch.manual_seed(seed)
    dynamics = HybridDynamics.hybrid(PENDULUM) if dynamics is None else dynamics
    return PolicyTrainer(PENDULUM, dynamics, config, seed=seed, **options)


def stored(replay) -> Batch:
    """All of a replay in its order."""
    parts = replay.rows[: len(replay)].split(replay.sizes, -1)
    state, action, reward, next_state, terminated = parts
    return Batch(state, action, reward[:, 0], next_state, terminated[:, 0] > 0.5)


def flat(state):
    """All tensors and numbers of a nested state, by path."""
    if isinstance(state, dict):
        items = state.items()
    elif isinstance(state, (list, tuple)):
        items = enumerate(state)
    else:
        return {"": state}
    return {f"{key}/{path}": v for key, part in items for path, v in flat(part).items()}


def assert_same_state(one, other, but=()):
    one, other = flat(one), flat(other)
    assert one.keys() == other.keys()
    for path, value in one.items():
        if path.rstrip("/") in but:
            continue
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, other[path]), path
        else:
            assert value == other[path], path


def plain(state):
    assert all(
        value is None or isinstance(value, (torch.Tensor, int, float))
        for value in flat(state).values()
    ), "tensors and numbers only, so that a checkpoint needs no pickled code"
