"""A figure and a GIF of an episode of an agent."""

from __future__ import annotations

import csv
import logging
from functools import partial
from pathlib import Path

from phihp_torchrl.config import names_file
from phihp_torchrl.deployment import Agent
from phihp_torchrl.evaluation.episode import Episode, draw_episode, play_episode
from phihp_torchrl.evaluation.figures import Curve, episode_figure
from phihp_torchrl.evaluation.predicted import Predictions, predict_episode
from phihp_torchrl.evaluation.seeds import evaluation_seed
from phihp_torchrl.evaluation.video import write_gif
from phihp_torchrl.worlds import SimulatedWorld, World

DOING = "drawing an episode"
"""What a run says that it is doing while this is on its stack."""

_log = logging.getLogger(__name__)


def show_episode(
    agent: Agent,
    directory: Path,
    *,
    world: World | None = None,
    name: str = "episode",
    video: bool = True,
    seed: int = 0,
    curve: Curve | None = None,
    played: Episode | None = None,
) -> list[Path]:
    """Play one episode of an agent and write a figure ``<name>.png`` and a GIF ``<name>.gif``.

    If the agent has a model, the figure shows what that predicts beside what happened. The numbers
    of both are in a table ``<name>.csv``.

    If there are no pictures of the world (no pygame, or a system without pictures), a warning is
    logged and only the figure is written.

    Args:
        agent: the agent.
        directory: directory of the files; it is made if absent.
        world: the world. Defaults to the simulated world of the agent's task.
        name: name of the files, without ending.
        video: whether to write the GIF.
        seed: number of the evaluation seed.
        curve: returns over real steps for the figure: points by what earned them.
        played: an episode that the agent has played in a simulated world, to show that instead.

    Returns:
        The pictures that were written.

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
    world = SimulatedWorld(agent.task) if world is None else world
    play = partial(play_episode, agent, agent.task, seed=evaluation_seed(seed), world=world)
    episode = played
    if video:
        try:
            if played is not None and isinstance(world, SimulatedWorld):
                episode = draw_episode(played, world)
            else:
                episode = play(render=True)
            files.append(write_gif(episode, directory / f"{name}.gif"))
        except (ImportError, ValueError) as error:
            _log.warning("No GIF of the episode: %s", error)
    if episode is None:
        episode = play()
    predicted = None
    if agent.dynamics is not None:
        predicted = predict_episode(agent.dynamics, episode)
    with names_file(files[0]):
        episode_figure(episode, predicted, curve).savefig(files[0], dpi=120)
    _write_table(episode, predicted, directory / f"{name}.csv")
    return files


def _write_table(episode: Episode, predicted: Predictions | None, path: Path) -> None:
    """Write an episode as a table, a row for each state; numbers that there are not are empty."""
    system, task = episode.task.system, episode.task
    with names_file(path), path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        foreseen = [f"predicted {name}" for name in system.state_names] if predicted else []
        table.writerow(["time", *system.state_names, *system.action_names, "reward", *foreseen])
        for i, state in enumerate(episode.states):
            row = [i * task.time_step, *state[: system.state_dim]]
            last = i == len(episode.actions)
            none = [""] * (len(system.action_names) + 1)
            row += none if last else [*episode.actions[i], episode.rewards[i]]
            if predicted is not None:
                none = [""] * system.state_dim
                row += [*predicted.states[i - 1, : system.state_dim]] if i else none
            table.writerow([v if isinstance(v, str) else f"{v:.7g}" for v in row])
