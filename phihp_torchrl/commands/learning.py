"""Training from Python in one call, from a task and a world to a trained agent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

from phihp_torchrl.commands.words import read_lines
from phihp_torchrl.config import ConfigError, kind_mapping, load_config, override_lines
from phihp_torchrl.deployment import Agent, load_agent, plain_defaults
from phihp_torchrl.tasks import Task, list_tasks, register_task
from phihp_torchrl.trainers import RunDirectory, read_run_config, resume_command, run, task_of
from phihp_torchrl.worlds import WORLDS, GivenConfig, World, make_world


class Learned(NamedTuple):
    """The result of :func:`learn`.

    Args:
        agent: the trained agent, loaded from the directory of the run.
        path: directory of the run, with settings, metrics, checkpoints, the agent and pictures.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.agents import Actor
        >>> task = get_task("pendulum")
        >>> agent, path = Learned(Agent(task, actor=Actor(task)), Path("outputs/my-run"))
        >>> agent.task.name, path.name
        ('pendulum', 'my-run')
    """

    agent: Agent
    path: Path


@plain_defaults()
def learn(
    task: str | Task,
    world: Any = "simulated",
    *,
    method: str = "phihp",
    preset: str = "default",
    overrides: Sequence[str] | Mapping[str, Any] = (),
    run_dir: str | Path | None = None,
    config_dir: str | Path | None = None,
) -> Learned:
    """Train an agent for a task in a world, as ``phihp train`` does.

    Args:
        task: a task, which is registered if it is not yet, or the name of a registered one.
        world: the source of real steps, in any form that :func:`~phihp_torchrl.make_world` accepts,
            recordings among them.
        method: ``"phihp"``, or the name of another registered method.
        preset: ``"default"`` or ``"paper"``.
        overrides: further settings, as on a command line or as a mapping from dotted keys.
        run_dir: directory of the run. Defaults to a new one under ``outputs/``.
        config_dir: directory of additional YAML files, such as settings of the task.

    Returns:
        The trained agent, and the directory of its run.

    Raises:
        ConfigError: before any real step, for a wrong setting, or a world that does not fit the
            task.
        RuntimeError: if the run was stopped by a signal; the message says how to resume it.

    Examples:
        >>> import tempfile
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task, learn
        >>> task = replace(get_task("pendulum"), name="short-pendulum", max_steps=5)
        >>> tiny = {"model.real_steps": 50, "model.fit.steps": 2, "policy.updates": 2}
        >>> tiny |= {"policy.evaluation_interval": 2, "policy.refit.interval": 0, "compile": False}
        >>> tiny |= {"policy.evaluation_episodes": 2, "policy.random_steps": 64}
        >>> tiny |= {"evaluate.episodes": 1, "evaluate.latency_actions": 0, "evaluate.video": False}
        >>> tiny |= {"planner.num_candidates": 8, "planner.top_k": 2, "progress": False}
        >>> tiny |= {"planner.num_policy_candidates": 2, "planner.planning_horizon": 2}
        >>> tiny |= {"planner.warm_start": False, "calibrate.enabled": False}
        >>> with tempfile.TemporaryDirectory() as place:
        ...     agent, path = learn(task, overrides=tiny, run_dir=f"{place}/run")
        ...     (path / "metrics.csv").is_file(), agent.task.name
        (True, 'short-pendulum')
    """
    words = override_lines(overrides)
    lines = read_lines(words)
    if isinstance(task, Task):
        if task.name not in list_tasks():
            register_task(task)
        task_name = task.name
    else:
        task_name = task
    settings = load_config(
        task_name,
        method=method,
        preset=preset,
        overrides=[*words, *_with_columns(world)],
        config_dir=config_dir,
    )
    if _with_columns(world):
        world = settings["world"]
    elif any(key.split(".")[0] == "world" for key in lines):
        if world != "simulated":
            raise ConfigError("world", "expected it as an argument or in overrides, got both.")
        world = settings["world"]
    given = read_run_config({**settings, "world": kind_mapping(GivenConfig())})
    reality = make_world(task_of(given, task if isinstance(task, Task) else None), world)
    settings["world"] = _world_settings(reality)
    if run_dir is None:
        run_dir = settings.get("run_dir")
    config = read_run_config(settings)
    if "evaluate" not in config.phases_to_do:
        raise ConfigError(
            "phases",
            f"expected 'evaluate' among them, which saves the agent, got "
            f"{list(config.phases_to_do)}. `phihp train` runs phases without it.",
        )
    result = run(config, run_dir, world=reality)
    if not result.finished:
        raise RuntimeError(f"stopped by a signal; go on with: {resume_command(result.path)}")
    directory = RunDirectory(result.path)
    return Learned(load_agent(directory.agent, task=reality.task), result.path)


def _with_columns(world: Any) -> list[str]:
    """The words for a world with columns, which the settings of a task may name as well."""
    if is_dataclass(world) and getattr(world, "kind", None) in WORLDS:
        world = kind_mapping(world)
    if not isinstance(world, Mapping) or world.get("kind") not in WORLDS:
        return []
    if "columns" not in {f.name for f in fields(WORLDS[world["kind"]].config)}:
        return []
    given = {f"world.{key}": value for key, value in world.items() if key != "kind"}
    return override_lines({"world": world["kind"], **given})


def _world_settings(world: World) -> dict[str, Any]:
    """Return the settings of a world for the run's configuration, or those of a given world."""
    config = getattr(world, "config", None)
    kind = WORLDS.get(world.kind)
    if kind is not None and isinstance(config, kind.config):
        return kind_mapping(config)
    return kind_mapping(GivenConfig())
