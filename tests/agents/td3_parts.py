"""A small TD3 and batches for it."""

from __future__ import annotations

import torch

from phihp_torchrl.agents import TD3Config, TD3Update, make_td3_loss
from phihp_torchrl.agents.update import layers
from phihp_torchrl.imagination import Batch
from phihp_torchrl.worlds import SimulatedWorld

SMALL = TD3Config(
    actor_hidden_sizes=(16, 16),
    critic_hidden_sizes=(16, 16, 16),
    actor_learning_rate=1e-3,
    critic_learning_rate=1e-3,
    last_layer_scale=1.0,
    tau=0.005,
)


def make_model(task="pendulum"):
    return SimulatedWorld(task).model()


def make_update(config=SMALL, task="pendulum", **options):
    model = make_model(task)
    return TD3Update(make_td3_loss(model, config), model, config, **options)


def make_batch(model, count):
    task = model.task
    state = (task.coverage or task.reset).sample([count])
    action = task.bounds.from_unit(2 * torch.rand(count, task.action_dim) - 1)
    next_state, reward, terminated = model.transition(state, action)
    terminated = terminated | (torch.rand(count) < 0.2)
    return Batch(state, action, reward, next_state, terminated)


def rows(batch, start, stop):
    return Batch(*(column[start:stop] for column in batch))


def copies(update):
    groups = {
        "actor": update.actor,
        "critics": update.critics,
        "target_actor": layers(update.loss.target_actor_network_params),
        "target_critics": layers(update.loss.target_qvalue_network_params),
    }
    return {name: [layer.clone() for layer in group] for name, group in groups.items()}


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
