"""One episode in full, to look at: states, actions, rewards and pictures."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from phihp_torchrl.envs.worlds import make_world
from phihp_torchrl.evaluation.seeds import EVALUATION_SEED
from phihp_torchrl.tasks import Task, get_task


@dataclass(frozen=True)
class Episode:
    """What happened in an episode of ``T`` steps.

    Args:
        task: the task.
        states: physical states, ``[T + 1, n]``.
        actions: actions in physical units, ``[T, m]``.
        rewards: rewards, ``[T]``.
        terminated: whether it ended before time ran out.
        frames: pictures ``[F, height, width, 3]``, uint8, of the start and of every
            ``frame_steps``-th step; empty if it was not rendered.
        frame_steps: steps from one picture to the next.
    """

    task: Task
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    rewards: NDArray[np.float64]
    terminated: bool
    frames: NDArray[np.uint8]
    frame_steps: int

    @property
    def total_reward(self) -> float:
        """The undiscounted return."""
        return float(self.rewards.sum())


def play_episode(
    policy: TensorDictModuleBase,
    task: str | Task,
    *,
    seed: int = EVALUATION_SEED,
    max_steps: int | None = None,
    render: bool = False,
    frames_per_second: float = 20.0,
    max_frames: int = 200,
    device: torch.device | str | None = None,
) -> Episode:
    """Play one episode in the task's gymnasium world. The global random state is left as it was.

    Args:
        policy: reads ``"observation"``, writes ``"action"``; called with batch size ``[]``.
        task: a task or the name of a registered one.
        seed: seed of the start and of the policy's noise.
        max_steps: stop earlier than the task does.
        render: whether to take pictures; needs the ``rendering`` extra.
        frames_per_second: pictures for a second of the world's time, at most one a step.
        max_frames: pictures at most, from the beginning; drawing takes longer than acting.
        device: where the policy acts.

    Raises:
        ImportError: if pictures are wanted and pygame is not installed.
        ValueError: if pictures are wanted of a system that has none, or a number is not positive.
    """
    task = get_task(task) if isinstance(task, str) else task
    steps = task.max_steps if max_steps is None else min(max_steps, task.max_steps)
    if steps < 1:
        raise ValueError(f"max_steps: expected a positive number, got {max_steps}.")
    if not frames_per_second > 0:
        raise ValueError(f"frames_per_second: expected a positive number, got {frames_per_second}.")
    frame_steps = max(1, round(1.0 / (frames_per_second * task.time_step)))
    world = make_world(task, render_mode=_render_mode() if render else None)
    inner: Any = world.unwrapped
    try:
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            torch.manual_seed(seed)
            observation, _ = world.reset(seed=seed)
            states, actions, rewards = [inner.state], [], []
            frames: list[Any] = [world.render()] if render else []
            terminated = False
            for step in range(1, steps + 1):
                tensordict = TensorDict(
                    observation=torch.from_numpy(observation).to(device),
                    is_init=torch.tensor([step == 1], device=device),
                )
                action = policy(tensordict)["action"].cpu().numpy()
                observation, reward, terminated, truncated, _ = world.step(action)
                states.append(inner.state)
                actions.append(action)
                rewards.append(reward)
                if render and step % frame_steps == 0 and len(frames) < max_frames:
                    frames.append(world.render())
                if terminated or truncated:
                    break
    finally:
        world.close()
    return Episode(
        task=task,
        states=np.stack(states),
        actions=np.stack(actions).astype(np.float64),
        rewards=np.array(rewards, dtype=np.float64),
        terminated=terminated,
        frames=np.stack(frames) if render else np.zeros((0, 0, 0, 3), dtype=np.uint8),
        frame_steps=frame_steps,
    )


def _render_mode() -> str:
    if importlib.util.find_spec("pygame") is None:
        raise ImportError(
            "pygame: expected it to draw pictures, it is not installed; "
            "`pip install 'phihp_torchrl[rendering]'` brings it."
        )
    return "rgb_array"
