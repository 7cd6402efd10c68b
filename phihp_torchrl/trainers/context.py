"""The arguments from which a phase is built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from phihp_torchrl.planners import SearchConfig
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.worlds import World


@dataclass(frozen=True)
class Context:
    """The arguments from which a run builds a phase; see :func:`~phihp_torchrl.register_phase`.

    Args:
        config: settings of the run.
        settings: the section of the phase in these settings.
        task: the task.
        world: the real world.
        before: the earlier phases of the run, which are done, by name.
        directory: directory of the run.
        compile: whether the phase is compiled: the run's choice where its settings say ``auto``.

    Examples:
        >>> from pathlib import Path
        >>> from phihp_torchrl import make_world
        >>> config, world = RunConfig("pendulum"), make_world("pendulum")
        >>> section, directory = config.section("model"), RunDirectory("outputs/my-run")
        >>> context = Context(config, section, world.task, world, {}, directory)
        >>> context.settings.kind, context.directory.path == Path("outputs/my-run")
        ('hybrid', True)
    """

    config: RunConfig
    settings: Any
    task: Task
    world: World
    before: Mapping[str, Any]
    directory: RunDirectory
    compile: bool = False

    @property
    def parts(self) -> dict[str, Any]:
        """What the earlier phases made, as arguments of :class:`~phihp_torchrl.Agent`."""
        parts: dict[str, Any] = {}
        for phase in self.before.values():
            parts |= getattr(phase, "parts", dict)()
        return parts

    @property
    def planner(self) -> SearchConfig | None:
        """Settings of the planner: its own, and what phases found where it has the default.

        So it discounts rewards as the critics do that value its end, unless its ``gamma`` is set.
        """
        planner = self.config.planner
        if planner is None:
            return None
        default = type(planner)()
        changes = {
            name: value
            for phase in self.before.values()
            for name, value in getattr(phase, "planner_changes", {}).items()
            if getattr(planner, name) == getattr(default, name)
        }
        return replace(planner, **changes)
