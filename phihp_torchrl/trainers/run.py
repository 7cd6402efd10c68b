"""A run: the phases of a method one after the other, logged, checkpointed and resumable."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from phihp_torchrl.config import ConfigError, names_file
from phihp_torchrl.deployment import plain_defaults
from phihp_torchrl.display import Progress
from phihp_torchrl.trainers.earlier import check_earlier
from phihp_torchrl.trainers.expected import expect
from phihp_torchrl.trainers.files import check_contained
from phihp_torchrl.trainers.interrupt import Interrupt
from phihp_torchrl.trainers.lock import RunLock
from phihp_torchrl.trainers.next_steps import resume_command
from phihp_torchrl.trainers.rehearsal import rehearse
from phihp_torchrl.trainers.report import report_run
from phihp_torchrl.trainers.run_checks import check_run
from phihp_torchrl.trainers.run_config import RunConfig, task_of
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.run_loop import RunLoop
from phihp_torchrl.trainers.start import begin, check_same, new_directory
from phihp_torchrl.trainers.warned import Warned
from phihp_torchrl.worlds import World, make_world


@dataclass(frozen=True)
class RunResult:
    """The result of :func:`run`.

    Args:
        path: directory of the run.
        finished: whether all its phases are done.
        signal: number of the signal that stopped it, or ``None``.
        metrics: the last value of every metric that this process logged.

    Examples:
        >>> result = RunResult(Path("outputs/my-run"), False, signal=15, metrics={})
        >>> f"resume={result.path}" if not result.finished else "done"
        'resume=outputs/my-run'
    """

    path: Path
    finished: bool
    signal: int | None
    metrics: dict[str, float]


@plain_defaults()
def run(
    config: RunConfig,
    path: str | Path | None = None,
    *,
    resume: bool = False,
    world: World | None = None,
) -> RunResult:
    """Run the phases of a method, with logs and checkpoints, or resume such a run.

    Each phase starts with the seed of the run, so that a phase that is run separately, from the
    results of earlier ones, gives the same result as in a whole run.

    Args:
        config: settings of the run.
        path: directory of the run; by default a new one under ``outputs/``.
        resume: whether to continue the run in ``path`` from its last checkpoint.
        world: the real world. Defaults to the one that ``config.world`` describes.

    Returns:
        The directory, whether the run is finished, and the last metrics.

    Raises:
        ConfigError: before any real step, if the directory holds another run, ``config`` differs
            from that of the run to resume, or another process works on it.
        CheckpointError: if no checkpoint of the run can be read.
        NonFiniteError: if a loss or a weight leaves the finite numbers; the checkpoints are those
            of before.

    Examples:
        >>> import tempfile
        >>> from phihp_torchrl.dynamics import FitConfig
        >>> from phihp_torchrl.trainers import ModelConfig
        >>> model = ModelConfig(real_steps=20, fit=FitConfig(steps=1))
        >>> options = {"phases": ("model",), "sections": {"model": model}, "progress": False}
        >>> with tempfile.TemporaryDirectory() as place:
        ...     result = run(RunConfig("pendulum", **options), f"{place}/run")
        ...     result.finished, (result.path / "metrics.csv").is_file()
        (True, True)
    """
    torch.set_num_threads(config.threads)
    # Adam's moments of unused weights become denormal, and those are slow.
    torch.set_flush_denormal(True)
    if world is None:
        world = make_world(task_of(config), config.world)
    check_run(config, world)
    if resume:
        if path is None:
            raise ConfigError("resume", "expected the directory of a run.")
        directory = RunDirectory(path, config.keep_checkpoints)
        check_same(config, directory)
        check_contained(directory.path)
    else:
        check_earlier(config, world.task)
        rehearse(config, world)
        config, directory = new_directory(config, path)
    with _told(directory), RunLock(directory.path):
        if not resume:
            begin(config, directory, world.task)
        expected = expect(config, directory.path)
        progress = Progress(expected.middle, enabled=config.progress)
        with Interrupt() as interrupt, progress, Warned() as warned:
            progress.say(f"{config.task}, {config.label}, in {directory.path}. {expected.words()}")
            loop = RunLoop(config, world, directory, interrupt, progress, warned)
            finished = loop.run()
        result = RunResult(directory.path, finished, interrupt.signal, loop.latest)
        if result.finished:
            report_run(directory, world)
    return result


@contextmanager
def _told(directory: RunDirectory) -> Iterator[None]:
    """Errors of files name at least the run, and say how it goes on."""
    try:
        with names_file(directory.path):
            yield
    except OSError as error:
        if directory.config.is_file():
            go_on = resume_command(directory.path)
            error.add_note(f"What was saved before is whole; go on with: {go_on}")
        raise
