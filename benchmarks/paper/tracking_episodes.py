"""Playing controllers of a motor's speed, and how far from the reference it is then."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from phihp_torchrl import Task, get_task
from phihp_torchrl.evaluation import EVALUATION_SEED
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

TASKS = ("motor", "motor-preview")
STEADY_STEPS = 150
"""Steps for which a constant reference is held; the last 50 of them count."""
WORLDS = {
    "as it is": {},
    "load of 0.2 Nm": {"friction": {"load": 0.2}},
    "inertia 1.5 times": {"constants": {"inertia": 0.015}},
}

Policy = Callable[[TensorDict], TensorDict]


def world_of(task: Task, changes: Mapping[str, Any]) -> SimulatedWorld:
    """The simulated world, with other constants or another load."""
    return SimulatedWorld(task, SimulatedConfig(**changes))


@torch.no_grad()
def play(
    policy: Policy,
    task: Task,
    changes: Mapping[str, Any],
    *,
    episodes: int,
    seed: int,
    steps: int | None = None,
    constant: bool = False,
) -> tuple[Tensor, Tensor]:
    """Speeds and references after each step, ``[steps, episodes]``.

    Args:
        policy: what acts.
        task: the task.
        changes: settings of the world.
        episodes: number of episodes.
        seed: seed of the first states and of the references.
        steps: steps of an episode. Defaults to the task's limit.
        constant: whether the reference stays at its first value.
    """
    model = world_of(task, changes).model()
    assert model is not None
    generator = torch.Generator().manual_seed(seed)
    without = get_task(TASKS[0])  # draws alike, whatever the preview
    state = task.at_rest(without.split(without.sample_start([episodes], generator))[0])
    drawn = without.outside.draw([episodes], task.max_steps + 1, generator)
    if constant:
        drawn = {name: values[:, :1] for name, values in drawn.items()}
    torch.manual_seed(seed)
    speeds, references = [], []
    for step in range(steps or task.max_steps):
        state = task.with_signals(state, task.outside.window(drawn, step))
        observed = TensorDict(
            observation=model.observe(state),
            is_init=torch.full([episodes, 1], step == 0),
            batch_size=[episodes],
        )
        state = model.transition(state, policy(observed)["action"]).next_state
        speeds.append(state[:, 0])
        references.append(task.outside.window(drawn, step + 1)[:, 0])
    return torch.stack(speeds), torch.stack(references)


def rms(speeds: Tensor, references: Tensor) -> float:
    """Root of the mean squared error over all steps and episodes, in rad/s."""
    return (speeds - references).square().mean().sqrt().item()


def loss(speeds: Tensor, references: Tensor) -> float:
    """The mean of what the task's reward takes."""
    speed, reference = speeds.unsqueeze(-1), references.unsqueeze(-1)
    motor = get_task("motor")
    return -motor.reward(speed, speed, speed, reference=reference).mean().item()


def measure(policy: Policy, task: Task, episodes: int) -> dict[str, dict[str, float]]:
    """RMS error on random references, and steady errors on constant ones, in each world."""
    found = {}
    for name, changes in WORLDS.items():
        options: dict[str, Any] = {"episodes": episodes, "seed": EVALUATION_SEED}
        moving = play(policy, task, changes, **options)
        speeds, references = play(
            policy, task, changes, steps=STEADY_STEPS, constant=True, **options
        )
        last = (speeds - references)[-50:]
        found[name] = {
            "rms": rms(*moving),
            "steady_error": last.mean(0).abs().mean().item(),
            "steady_error_largest": last.mean(0).abs().max().item(),
            "steady_ripple": last.std(0).mean().item(),
        }
    return found
