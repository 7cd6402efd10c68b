"""Several seeds of one task trained at once, by batched weights, against one after the other."""

from __future__ import annotations

import pytest
import torch
from race import race
from torch import Tensor

from phihp_torchrl import HybridDynamics, get_task, load_config
from phihp_torchrl.agents import (
    Networks,
    TD3Update,
    actor_loss,
    adam_,
    adam_rates,
    critic_loss,
    make_td3_loss,
    soft_update_,
    td3_target,
)
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Batch
from phihp_torchrl.trainers import read_run_config


class Together:
    """The step of :class:`~phihp_torchrl.agents.TD3Update` for several seeds in one.

    Args:
        updates: one for each seed, with a model and hyper-parameters that are the same for all.
    """

    def __init__(self, updates: list[TD3Update]) -> None:
        self.first = updates[0]
        groups = zip(*(update.networks for update in updates), strict=True)
        stacked = ([torch.stack(each) for each in zip(*group, strict=True)] for group in groups)
        self.nets = Networks(*stacked)
        self.steps = torch.zeros((), dtype=torch.float64)

    def __call__(self, batch: Batch) -> None:
        """Train on batches ``[seeds, policy_delay * N]``."""
        first, nets, config = self.first, self.nets, self.first.config
        model, bounds, delay = first.world_model, first.bounds, first.config.policy_delay
        noise = (config.target_noise * torch.randn_like(batch.action)).clamp(
            -config.target_noise_clip, config.target_noise_clip
        )

        def targets(batch: Batch, actor: list[Tensor], critics: list[Tensor], noise: Tensor):
            return td3_target(
                batch,
                actor,
                critics,
                noise * bounds.scale,
                bounds,
                config.gamma,
                model.observe,
                model.transition,
                config.value_expansion,
            )

        target = torch.vmap(targets)(batch, nets.target_actor, nets.target_critics, noise)
        parts = (part.chunk(delay, dim=1) for part in (batch.state, batch.action, target))
        for i, (state, action, value) in enumerate(zip(*parts, strict=True)):
            observation = model.observe(state)
            self._descend(
                nets.critics,
                (nets.critic_means, nets.critic_squares),
                lambda layers, *of: critic_loss(layers, *of, bounds),
                (observation, action, value),
                adam_rates(self.steps * delay + i + 1, config.critic_learning_rate),
            )
        self._descend(
            nets.actor,
            (nets.actor_means, nets.actor_squares),
            lambda layers, critics, seen: actor_loss(layers, critics, seen, bounds),
            (nets.critics, observation),
            adam_rates(self.steps + 1, config.actor_learning_rate),
        )
        soft_update_(nets.target_actor, nets.actor, config.tau)
        soft_update_(nets.target_critics, nets.critics, config.tau)
        self.steps += 1

    def _descend(self, layers, moments, loss, arguments, rates) -> None:
        """Take a step of Adam; the losses of the seeds have nothing in common."""
        with torch.enable_grad():
            leaves = [layer.detach().requires_grad_() for layer in layers]
            total = torch.vmap(loss)(leaves, *arguments).sum()
            gradients = torch.autograd.grad(total, leaves, materialize_grads=True)
        adam_(layers, gradients, *moments, *rates)


def seeds_of(
    task_name: str, seeds: int, overrides: list[str] | None = None
) -> tuple[list[TD3Update], list[Batch]]:
    """An update and a batch for each seed, by the task's default preset."""
    loaded = load_config(task_name, overrides=overrides or [])
    task, config = get_task(task_name), read_run_config(loaded).section("policy")
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    updates, batches = [], []
    for seed in range(seeds):
        torch.manual_seed(seed)
        updates.append(TD3Update(make_td3_loss(model, config.td3), model, config.td3))
        state = task.coverage.sample([config.td3.policy_delay * config.batch_size])
        action = task.bounds.from_unit(2.0 * torch.rand(len(state), task.action_dim) - 1.0)
        step = model.transition(state, action)
        batches.append(Batch(state, action, step.reward, step.next_state, step.terminated))
    return updates, batches


@pytest.mark.parametrize("task", ["pendulum-swingup", "acrobot"])
def test_seeds(benchmark, report, task):
    contenders = {}
    for seeds in (1, 2, 4):
        with torch.no_grad():
            updates, batches = seeds_of(task, seeds)
            together = Together(updates)
            batch = Batch(*(torch.stack(parts) for parts in zip(*batches, strict=True)))

        def apart(updates=updates, batches=batches):
            for update, own in zip(updates, batches, strict=True):
                update(own)

        def at_once(together=together, batch=batch):
            together(batch)

        contenders |= {f"{seeds} apart": apart, f"{seeds} at once": at_once}
    times = race(benchmark, contenders, rounds=40)
    per_seed = {
        name: [time / int(name.split()[0]) for time in times] for name, times in times.items()
    }
    note = (
        f"Networks, batch and value expansion of {task}'s default preset, uncompiled, one thread; "
        "the time is for one round of each seed: two critic updates, one of the actor and of the "
        "targets. *At once*: weights of all seeds stacked, `torch.vmap` over the losses."
    )
    report(f"Updates of several seeds, {task}", per_seed, note)


def test_at_once_is_the_same_as_apart():
    """The target noise apart, which is switched off here."""
    with torch.no_grad():
        updates, batches = seeds_of("pendulum-swingup", 2, ["policy.td3.target_noise=0"])
        together = Together(updates)
        together(Batch(*(torch.stack(parts) for parts in zip(*batches, strict=True))))
        for update, own in zip(updates, batches, strict=True):
            update(own)
    for seed, update in enumerate(updates):
        for ours, theirs in zip(together.nets.critics, update.critics, strict=True):
            torch.testing.assert_close(ours[seed], theirs, rtol=1e-4, atol=1e-6)
