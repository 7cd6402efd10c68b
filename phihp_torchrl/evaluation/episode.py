"""One episode in full: states, actions, rewards and pictures."""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from phihp_torchrl.config import ConfigError
from phihp_torchrl.evaluation.seeds import EVALUATION_SEED
from phihp_torchrl.tasks import Task, find_task
from phihp_torchrl.worlds import SimulatedWorld, World

_COLUMNS = ("states", "actions", "rewards")


@dataclass(frozen=True)
class Episode:
    """The states, actions, rewards and pictures of an episode of ``T`` steps.

    Args:
        task: the task.
        states: states as observed, angles in [-π, π], ``[T + 1, n]``.
        actions: actions in physical units, ``[T, m]``.
        rewards: rewards, ``[T]``.
        terminated: whether it ended before time ran out.
        frames: pictures ``[F, height, width, 3]``, uint8, of the start and of every
            ``frame_steps``-th step; empty if it was not rendered.
        frame_steps: steps from one picture to the next.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> steps = np.zeros((3, 2)), np.zeros((2, 1)), np.array([-1.0, -2.0])
        >>> Episode(get_task("pendulum"), *steps, False).total_reward
        -3.0
    """

    task: Task
    states: NDArray[np.float64]
    actions: NDArray[np.float64]
    rewards: NDArray[np.float64]
    terminated: bool
    frames: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 0, 0, 3), np.uint8))
    frame_steps: int = 1

    @property
    def total_reward(self) -> float:
        """The undiscounted return."""
        return float(self.rewards.sum())

    def to_tensors(self) -> dict[str, Any]:
        """All but the pictures, as a checkpoint keeps it."""
        columns = {name: torch.from_numpy(getattr(self, name)) for name in _COLUMNS}
        return {**columns, "terminated": self.terminated}

    @classmethod
    def from_tensors(cls, task: Task, kept: Mapping[str, Any]) -> Episode:
        """The episode of :meth:`to_tensors`."""
        columns = {name: kept[name].numpy() for name in _COLUMNS}
        return cls(task, **columns, terminated=bool(kept["terminated"]))


def play_episode(
    policy: TensorDictModuleBase,
    task: str | Task,
    *,
    seed: int = EVALUATION_SEED,
    world: World | None = None,
    max_steps: int | None = None,
    render: bool = False,
    frames_per_second: float = 20.0,
    max_frames: int = 200,
    device: torch.device | str | None = None,
) -> Episode:
    """Play one episode in a world and record it. Global random states are restored.

    Args:
        policy: a module that reads ``"observation"`` and writes ``"action"``, called with batch
            size ``[]``.
        task: a task or the name of a registered one.
        seed: seed of the first state and of the policy's noise.
        world: the world. Defaults to the simulated world of the task.
        max_steps: largest number of steps, if smaller than that of the task.
        render: whether to take pictures; needs the ``rendering`` extra.
        frames_per_second: pictures for each second in the world, at most one for each step.
        max_frames: largest number of pictures; later steps have none.
        device: device of the policy.

    Returns:
        The recorded episode.

    Raises:
        ImportError: if ``render`` is set and pygame is not installed.
        ConfigError: if ``render`` is set and the world has no pictures, or a number is not
            positive.

    Examples:
        >>> from phihp_torchrl import Agent, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> agent = Agent(get_task("pendulum"), actor=Actor(get_task("pendulum")))
        >>> episode = play_episode(agent, "pendulum", max_steps=5)
        >>> episode.states.shape, episode.actions.shape, len(episode.frames)
        ((6, 2), (5, 1), 0)
    """
    task = find_task(task)
    steps = task.max_steps if max_steps is None else min(max_steps, task.max_steps)
    if steps < 1:
        raise ConfigError("max_steps", f"expected a positive number, got {max_steps}.")
    frame_steps = _frame_steps(task, frames_per_second)
    world = SimulatedWorld(task) if world is None else world
    if render:
        _prepare_pygame(world)
    env = world.make_env(render=render)
    frames: list[Any] = []
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        env.set_seed(seed)
        data = env.reset()
        if render:
            frames.append(_picture(world, env))
        rows = []
        for step in range(1, steps + 1):
            data["is_init"] = torch.tensor([step == 1])
            data["action"] = policy(data.to(device) if device else data)["action"].cpu()
            data = env.step(data)
            rows.append(data)
            if render and step % frame_steps == 0 and len(frames) < max_frames:
                frames.append(_picture(world, env))
            if data["next", "done"].any():
                break
            data = step_mdp(data)
    observed = [rows[0]["observation"], *(row["next", "observation"] for row in rows)]
    states = task.locate(torch.stack(observed).double())
    return Episode(
        task=task,
        states=states.numpy(),
        actions=torch.stack([row["action"] for row in rows]).double().numpy(),
        rewards=torch.stack([row["next", "reward"].reshape(()) for row in rows]).double().numpy(),
        terminated=bool(rows[-1]["next", "terminated"].any()),
        **({"frames": np.stack(frames)} if render else {}),
        frame_steps=frame_steps,
    )


def draw_episode(
    episode: Episode,
    world: SimulatedWorld,
    *,
    frames_per_second: float = 20.0,
    max_frames: int = 200,
) -> Episode:
    """Draw an episode from its states, which have been played already.

    Args:
        episode: an episode, such as :attr:`~phihp_torchrl.evaluation.Evaluation.first`.
        world: the simulated world in which it was played.
        frames_per_second: pictures for each second in the world, at most one for each step.
        max_frames: largest number of pictures; later steps have none.

    Returns:
        The same episode with pictures.

    Raises:
        ImportError: if pygame is not installed.
        ConfigError: if the world has no pictures, or ``frames_per_second`` is not positive.

    Examples:
        >>> from phihp_torchrl.worlds import SimulatedWorld
        >>> from phihp_torchrl import Agent, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> task = get_task("pendulum")
        >>> episode = play_episode(Agent(task, actor=Actor(task)), task, max_steps=5)
        >>> draw_episode(episode, SimulatedWorld(task)).frames.shape
        (6, 500, 500, 3)
    """
    _prepare_pygame(world)
    frame_steps = _frame_steps(episode.task, frames_per_second)
    shown = range(0, len(episode.states), frame_steps)[:max_frames]
    env = world.make_env(render=True)
    pictures = []
    for step in shown:
        action = episode.actions[step - 1] if step else None
        world.place(env, episode.states[step], action)
        pictures.append(_picture(world, env))
    return replace(episode, frames=np.stack(pictures), frame_steps=frame_steps)


def _frame_steps(task: Task, frames_per_second: float) -> int:
    """Steps from one picture to the next."""
    if not frames_per_second > 0:
        raise ConfigError(
            "frames_per_second", f"expected a positive number, got {frames_per_second}."
        )
    return max(1, round(1.0 / (frames_per_second * task.time_step)))


def _picture(world: World, env: EnvBase) -> NDArray[Any]:
    picture = world.picture(env)
    if picture is None:
        raise ConfigError("render", f"expected a world that draws pictures, {world} draws none.")
    return picture


def _prepare_pygame(world: World) -> None:
    """Refuse to draw without pygame, which without a display is told that there is none.

    It would print an error about that otherwise, although its pictures need no display.
    """
    if not isinstance(world, SimulatedWorld):
        return
    if importlib.util.find_spec("pygame") is None:
        raise ImportError(
            "pygame: expected it to draw pictures, it is not installed; "
            "`pip install 'phihp_torchrl[rendering]'` brings it."
        )
    if sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
