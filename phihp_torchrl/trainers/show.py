"""A picture and a GIF of an agent at work."""

from __future__ import annotations

import logging
from pathlib import Path

from phihp_torchrl.deployment import Agent
from phihp_torchrl.evaluation import episode_figure, evaluation_seed, play_episode, write_gif

_log = logging.getLogger(__name__)


def show_episode(
    agent: Agent, directory: Path, *, name: str = "episode", video: bool = True, seed: int = 0
) -> list[Path]:
    """Play one real episode and write ``<name>.png`` and ``<name>.gif``.

    Where pictures of the world cannot be had (no pygame, or a system that draws none), a warning
    says so and the GIF is left out.

    Args:
        agent: who plays.
        directory: where to; made if absent.
        name: of the files.
        video: whether to write the GIF.
        seed: which of the evaluation seeds.

    Returns:
        The files written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    files = [directory / f"{name}.png"]
    episode = None
    if video:
        try:
            episode = play_episode(agent, agent.task, seed=evaluation_seed(seed), render=True)
            files.append(write_gif(episode, directory / f"{name}.gif"))
        except (ImportError, ValueError) as error:
            _log.warning("No GIF of the episode: %s", error)
    if episode is None:
        episode = play_episode(agent, agent.task, seed=evaluation_seed(seed))
    episode_figure(episode).savefig(files[0], dpi=120)
    return files
