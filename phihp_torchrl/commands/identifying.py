"""The part of ``phihp identify`` that needs torch: read or take steps, fit, print and write."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from phihp_torchrl.commands.identify import IdentifyJob
from phihp_torchrl.config import (
    ConfigError,
    from_mapping,
    load_config,
    override_lines,
    read_kind,
)
from phihp_torchrl.identification import (
    Finding,
    Identification,
    IdentifyConfig,
    check_system,
    identify,
    ready_to_paste,
    report_page,
)
from phihp_torchrl.recordings import RecordedData, read_recordings
from phihp_torchrl.tasks import Task, find_task
from phihp_torchrl.trainers import CollectConfig, new_run_directory, record, write_atomically
from phihp_torchrl.worlds import WORLDS, RecordedConfig, World, make_world

SHARED = ("task", "world", "model", "plugins")
"""Words that a run has too, and that the settings of a task may change."""
_OF_STEPS = ("world", "model", "steps", "seed", "out_dir")
"""Words that another fit of the same steps has no use for."""
_NEAR = 0.02
"""How far the steps of recordings may be from those of the task, as a share, without a word."""


def identify_as(job: IdentifyJob, words: Sequence[str], config_dir: str | None) -> Identification:
    """Identify as a job says, print the result, and write a report.

    Args:
        job: the settings.
        words: the assignments that they were read from.
        config_dir: a directory of further YAML files, such as settings of the task.

    Returns:
        The identification.

    Raises:
        ConfigError: for settings that do not fit, before any real step; and for recordings that
            cannot be read or fitted.
    """
    torch.set_num_threads(job.threads)
    config = from_mapping(IdentifyConfig, job.identify, "identify")
    shared = [word for word in words if _section(word) in SHARED]
    settings = load_config(overrides=shared, config_dir=config_dir)
    task = find_task(job.task).with_actuator(settings["actuator"])
    check_system(task.system)
    kind = read_kind(WORLDS, settings["world"], "world")
    if isinstance(kind, RecordedConfig):
        data = _read(task, kind)
        found, directory = identify(task, data.recordings, config), _directory(job)
        origin = "recordings"
    else:
        world = make_world(task, kind)
        collect = from_mapping(CollectConfig, settings["model"]["collect"], "model.collect")
        directory = _directory(job)
        log = _take(world, collect, job, directory)
        found, data = _fit_kept(task, log, config, words)
        origin = f"{job.steps} steps in {world}"
    found = _with_reading(task, found, data)
    _tell(task, found, directory, f"{task.name}, identified from {origin}")
    return found


def _section(word: str) -> str:
    return word.lstrip("+").split("=", 1)[0].split(".")[0]


def _directory(job: IdentifyJob) -> Path:
    if job.out_dir is None:
        return new_run_directory(job.task, "identification")
    path = Path(job.out_dir)
    path.mkdir(parents=True, exist_ok=True)
    return path


def _read(task: Task, config: RecordedConfig) -> RecordedData:
    """The recordings as they were measured: velocities without a column are not estimated."""
    try:
        return read_recordings(
            task,
            config.files,
            config.columns,
            time_step=config.time_step,
            gap=config.gap,
            decimal=config.decimal,
        )
    except ConfigError as error:
        raise error.inside("world") from error


def _take(world: World, collect: CollectConfig, job: IdentifyJob, directory: Path) -> Path:
    """Take real steps, and keep them before anything can fail."""
    log = record(world, collect, job.steps, job.seed, directory / "steps.csv")
    print(f"wrote {log}")  # noqa: T201 (a console command)
    return log


def _fit_kept(
    task: Task, log: Path, config: IdentifyConfig, words: Sequence[str]
) -> tuple[Identification, RecordedData]:
    """Fit steps that were kept, and say how to try again where that fails."""
    try:
        data = read_recordings(task, log)
        return identify(task, data.recordings, config), data
    except Exception as error:
        kept = [word for word in words if _section(word) not in _OF_STEPS]
        again = ["phihp", "identify", *kept, "world=recorded"]
        again += override_lines({"world.files": str(log)})
        hint = f"The steps are kept; try again without new ones: {shlex.join(again)}"
        if isinstance(error, ConfigError):
            raise ConfigError(error.key, f"{error.reason} {hint}") from error
        error.add_note(hint)
        raise


def _with_reading(task: Task, found: Identification, data: RecordedData) -> Identification:
    """The identification with what was read, and with a word where steps are not the task's."""
    warnings, step = list(found.warnings), found.data["step_s"]
    if abs(step / task.time_step - 1.0) > _NEAR:
        warnings.append(
            Finding(
                "time_step",
                f"The recordings have a step of {step:.4g} s, and task {task.name!r} has "
                f"{task.time_step:g} s.",
                "The lines for the task count the delay in its own steps; give the task the time "
                "step at which it will run.",
            )
        )
    counts = {name: count for name, count in data.counts.items() if count}
    read = {"read": counts, **found.data, "notes": list(data.notes)}
    settings = {"task": task.name, **found.settings}
    return replace(found, data=read, settings=settings, warnings=tuple(warnings))


def _tell(task: Task, found: Identification, directory: Path, title: str) -> None:
    """Print the result, and write it as JSON and as a page."""
    lines = ready_to_paste(task, found)
    print(f"{title}\n\n{found.table()}")  # noqa: T201 (a console command)
    for place, text in lines.items():
        print(f"\n{place}:\n{text}")  # noqa: T201
    page = directory / "identification.html"
    write_atomically(page, report_page(found, title=title, lines=lines))
    print(f"\nwrote {found.save(directory / 'identification.json')}")  # noqa: T201
    print(f"wrote {page}")  # noqa: T201
