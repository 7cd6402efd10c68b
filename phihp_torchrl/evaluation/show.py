"""A figure and a GIF of an episode of an agent."""

from __future__ import annotations

import logging
from pathlib import Path

from phihp_torchrl.deployment import Agent
from phihp_torchrl.evaluation.episode import play_episode
from phihp_torchrl.evaluation.figures import episode_figure
from phihp_torchrl.evaluation.seeds import evaluation_seed
from phihp_torchrl.evaluation.video import write_gif
from phihp_torchrl.worlds import World

_log = logging.getLogger(__name__)


def show_episode(
    agent: Agent,
    directory: Path,
    *,
    world: World | None = None,
    name: str = "episode",
    video: bool = True,
    seed: int = 0,
) -> list[Path]:
    """Play one episode of an agent and write a figure ``<name>.png`` and a GIF ``<name>.gif``.

    If there are no pictures of the world (no pygame, or a system without pictures), a warning is
    logged and only the figure is written.

    Args:
        agent: the agent.
        directory: directory of the files; it is made if absent.
        world: the world. Defaults to the simulated world of the agent's task.
        name: name of the files, without ending.
        video: whether to write the GIF.
        seed: number of the evaluation seed.

    Returns:
        The files that were written.

    Examples:
        >>> import tempfile
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.agents import Actor
        >>> task = replace(get_task("pendulum"), max_steps=5)
        >>> with tempfile.TemporaryDirectory() as place:
        ...     files = show_episode(Agent(task, actor=Actor(task)), Path(place), video=False)
        ...     [(file.name, file.is_file()) for file in files]
        [('episode.png', True)]
    """
    directory.mkdir(parents=True, exist_ok=True)
    files = [directory / f"{name}.png"]
    episode = None
    if video:
        try:
            episode = play_episode(
                agent, agent.task, seed=evaluation_seed(seed), world=world, render=True
            )
            files.append(write_gif(episode, directory / f"{name}.gif"))
        except (ImportError, ValueError) as error:
            _log.warning("No GIF of the episode: %s", error)
    if episode is None:
        episode = play_episode(agent, agent.task, seed=evaluation_seed(seed), world=world)
    episode_figure(episode).savefig(files[0], dpi=120)
    return files
