"""Real steps of a world as a log, for whoever wants the steps and no agent."""

from __future__ import annotations

import csv
import logging
from collections import Counter
from pathlib import Path

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, names_file
from phihp_torchrl.trainers.collect import CollectConfig, random_policy, steady, within_rate
from phihp_torchrl.trainers.exploration import Exploration
from phihp_torchrl.worlds import World, crossings_text, guard_env

_log = logging.getLogger(__name__)


def record(world: World, config: CollectConfig, steps: int, seed: int, path: Path) -> Path:
    """Take real steps with the exploration of phase 1, and write them to a CSV file as they come.

    The file has the columns ``time``, ``episode`` and one for each state, action and input of the
    task's system, so that ``world=recorded world.files=...`` reads it without further words. The
    last row of an episode repeats the command before, which nothing follows.

    Args:
        world: a world in which one can act.
        config: the exploration, its limits and guards.
        steps: real steps in all.
        seed: of the world and of the policy.
        path: the file.

    Returns:
        The path of the file.

    Raises:
        ConfigError: for a world of recordings.

    Examples:
        >>> import tempfile
        >>> from phihp_torchrl.worlds import make_world
        >>> place = Path(tempfile.mkdtemp()) / "steps.csv"
        >>> log = record(make_world("pendulum"), CollectConfig(), 3, 0, place)
        >>> log.read_text().splitlines()[0], len(log.read_text().splitlines())
        ('time,episode,theta,theta_dot,torque', 5)
    """
    if not world.has_env:
        raise ConfigError("world", f"{world} has recordings alone, nobody can act in it.")
    task = world.task
    generator = torch.Generator().manual_seed(seed)
    exploration = Exploration(task, config.exploration)
    policy = steady(task, random_policy(task, config, generator, exploration))
    policy = within_rate(task, policy)
    crossings: Counter[str] = Counter()
    env = guard_env(world.make_env(), task, config.exploration.guards, crossings)
    env.set_seed(seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    writing = path.open("w", newline="", encoding="utf-8")
    with torch.no_grad(), names_file(path), writing as file:
        table = csv.writer(file)
        system = task.system
        names = (*system.state_names, *system.action_names, *system.input_names)
        table.writerow(["time", "episode", *names])

        def write(place: int, observation: Tensor, action: Tensor) -> None:
            state, registers = task.split(task.locate(observation))
            inputs = task.outside.values(registers).get("inputs", registers[:0])
            numbers = [*state.tolist(), *action.tolist(), *inputs.tolist()]
            known = [f"{v:.9g}" if abs(v) < float("inf") else "" for v in numbers]
            table.writerow([f"{place * task.time_step:.9g}", episode, *known])

        now, episode, place = env.reset(), 0, 0
        for k in range(steps):
            stepped, following = env.step_and_maybe_reset(policy(now))
            action = stepped["action"].float()
            write(place, stepped["observation"], action)
            over = bool(stepped["next", "done"])
            if over or k == steps - 1:
                write(place + 1, stepped["next", "observation"], action)
            now, place = following, 0 if over else place + 1
            episode += over
            if over:
                file.flush()
    if crossings:
        _log.warning("Guards ended %d episodes: %s.", crossings.total(), crossings_text(crossings))
    return path
