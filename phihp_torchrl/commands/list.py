"""``phihp list``: tasks, methods, presets, worlds, planners and baselines, a line each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from phihp_torchrl.commands.words import run_command
from phihp_torchrl.config import METHODS, YAML, check_fields


@dataclass(frozen=True)
class ListConfig:
    """Settings of ``phihp list``.

    Args:
        plugins: Python files or modules to import first, which register more.
    """

    plugins: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)


def main(words: Sequence[str]) -> None:
    """Print the registered tasks, methods, presets, worlds, planners and baselines."""
    run_command(ListConfig, words, "phihp list [plugins=[my_task.py]]", _do)


def _do(config: ListConfig) -> None:
    print(listing(config))  # noqa: T201 (a console command)


def listing(config: ListConfig | None = None) -> str:
    """List tasks, methods, presets, worlds, planners and baselines, under a heading for each.

    Examples:
        >>> listing().splitlines()[0]
        'tasks (task=...)'
    """
    from phihp_torchrl.baselines import BASELINES
    from phihp_torchrl.planners import PLANNERS
    from phihp_torchrl.tasks import get_task, list_tasks
    from phihp_torchrl.trainers import import_plugins
    from phihp_torchrl.worlds import WORLDS

    import_plugins((config or ListConfig()).plugins)
    sections = {
        "tasks (task=...)": {
            name: f"{', '.join(get_task(name).system.state_names)}; "
            f"{get_task(name).max_steps} steps of {get_task(name).time_step:g} s"
            for name in list_tasks()
        },
        "methods (method=...)": {name: method.about for name, method in METHODS.items()},
        "presets (preset=...)": {
            path.stem: _about(path.read_text(encoding="utf-8"))
            for path in sorted((YAML / "preset").glob("*.yaml"))
        },
        "worlds (world=...)": {name: kind.about for name, kind in WORLDS.items()},
        "planners (planner=...)": {name: kind.about for name, kind in PLANNERS.items()},
        "baselines (evaluate.baselines=[...])": {
            name: f"{kind.about}{'; only where named' if kind.slow else ''}"
            for name, kind in BASELINES.items()
        },
    }
    lines = []
    for title, entries in sections.items():
        lines += [title, *(f"  {name:<28} {about}" for name, about in entries.items()), ""]
    return "\n".join(lines).rstrip()


def _about(text: str) -> str:
    comment = next(line for line in text.splitlines() if not line.startswith("# @"))
    return comment.lstrip("# ").rstrip(".")
