"""A run: the phases of a method one after the other, logged, checkpointed and resumable."""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.checkpoint import CheckpointError, GlobalRNGState

from phihp_torchrl.config import ConfigError, names_file, resolve_seconds
from phihp_torchrl.deployment import plain_defaults
from phihp_torchrl.display import Progress
from phihp_torchrl.origin import describe_origin
from phihp_torchrl.trainers.checkpoints import clear_rotation, load_latest, load_state
from phihp_torchrl.trainers.compile_choice import earned
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.expected import expect
from phihp_torchrl.trainers.files import check_contained
from phihp_torchrl.trainers.finite import check_finite
from phihp_torchrl.trainers.headline import headline
from phihp_torchrl.trainers.interrupt import Abandoned, Interrupt
from phihp_torchrl.trainers.keeper import Keeper
from phihp_torchrl.trainers.lock import RunLock
from phihp_torchrl.trainers.loggers import REAL_STEPS, RunLogger, make_logger
from phihp_torchrl.trainers.metrics_table import MetricsTable
from phihp_torchrl.trainers.next_steps import resume_command
from phihp_torchrl.trainers.phases import PHASES, Phase, real_steps
from phihp_torchrl.trainers.rehearsal import rehearse
from phihp_torchrl.trainers.report import report_run
from phihp_torchrl.trainers.run_checks import check_run
from phihp_torchrl.trainers.run_config import RunConfig, task_of
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.run_record import RunRecord
from phihp_torchrl.trainers.start import begin, check_same, new_directory
from phihp_torchrl.trainers.warned import Warned
from phihp_torchrl.worlds import World, make_world

_log = logging.getLogger(__name__)


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


@dataclass
class _Position:
    """The progress of a run, which is part of every checkpoint."""

    unit: int  # units of work done, over all phases; also the rows of metrics.csv
    real_steps: int
    seconds: dict[str, float]  # by phase


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
        rehearse(config, world)
        config, directory = new_directory(config, path)
    with _told(directory), RunLock(directory.path):
        if not resume:
            begin(config, directory)
        expected = expect(config, directory.path)
        progress = Progress(expected.middle, enabled=config.progress)
        with Interrupt() as interrupt, progress, Warned() as warned:
            progress.say(f"{config.task}, {config.label}, in {directory.path}. {expected.words()}")
            result = _Run(config, world, directory, interrupt, progress, warned).run()
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


class _Run:
    """The loop over phases, and over the units of each."""

    def __init__(
        self,
        config: RunConfig,
        world: World,
        directory: RunDirectory,
        interrupt: Interrupt,
        progress: Progress,
        warned: Warned,
    ) -> None:
        self.config = config
        self.world = world
        self.directory = directory
        self.interrupt = interrupt
        self.progress = progress
        self.warned = warned
        self.origin = {"task": config.task}
        self.keeper = Keeper(directory.rotation, self.origin, interrupt)
        self.phases: dict[str, Phase] = {}
        self.position = _Position(0, 0, {})
        self.latest: dict[str, float] = {}
        self.record = RunRecord(directory)

    def run(self) -> RunResult:
        table, logger, finished = None, RunLogger(), True
        try:
            for name in (*self.config.phases_before, *self.config.phases_to_do):
                _seed_everything(self.config.seed)
                with self.interrupt.work():
                    phase = self._make_phase(name)
                self.phases[name] = phase
                if self.directory.phase(name).exists():
                    state = load_state(self.directory.phase(name), metadata=self.origin)
                    self._restore(phase, state, ours=name in self.config.phases_to_do)
                    self.progress.restored(name, self.position.seconds.get(name, 0.0))
                    continue
                self._resume_phase(name, phase)
                if table is None:
                    table, logger = self._open_logs()
                if hasattr(phase, "keep"):
                    phase.keep = partial(self._save, name, phase)
                finished = self._advance(name, phase, table, logger)
                if not finished:
                    break
                self._finish(name, phase)
        except Abandoned:
            finished = False
            self.keeper.save_frozen()
        finally:
            self._note_warnings()
            logger.close()
        if table is None and finished:  # everything was done before
            self.record.complete(self.phases, self.position.unit)
        return RunResult(self.directory.path, finished, self.interrupt.signal, self.latest)

    def _make_phase(self, name: str) -> Phase:
        world = self.world
        for phase in self.phases.values():  # one may have found out more of the world's task
            known = getattr(phase, "world", None)
            world = known if isinstance(known, World) else world
        settings = resolve_seconds(self.config.section(name), world.task.time_step)
        context = Context(
            config=self.config,
            settings=settings,
            task=world.task,
            world=world,
            before=dict(self.phases),
            directory=self.directory,
            compile=self._compiles(name, settings, world),
        )
        return PHASES[name].build(context)

    def _compiles(self, name: str, settings: Any, world: World) -> bool:
        """Whether a phase is compiled; what was chosen once is kept, and said."""
        if isinstance(self.config.compile, bool):
            return self.config.compile
        chosen = self.record.metadata.setdefault("compiled", {})
        if name not in chosen:
            found = earned(self.config, name, settings, world)
            chosen[name] = found.pays
            if found.taken and name in self.config.phases_to_do:
                self.progress.say(found.words(name))
        return bool(chosen[name])

    def _advance(self, name: str, phase: Phase, table: MetricsTable, logger: RunLogger) -> bool:
        """Work through a phase; false if a signal ended it early."""
        position, saved = self.position, time.monotonic()
        self.progress.begin(name, phase.progress, PHASES[name].unit)
        while not phase.done:
            if self.interrupt:
                self._save(name, phase)
                return False
            self.keeper.freeze(partial(self._state, name, phase), position.unit)
            start = time.monotonic()
            with self.interrupt.work():
                metrics = phase.advance()
            check_finite(
                phase, metrics, name=name, unit=PHASES[name].unit, directory=self.directory.path
            )
            seconds = position.seconds.get(name, 0.0) + time.monotonic() - start
            position.seconds[name] = seconds
            position.real_steps = real_steps(self.phases)
            self._log_unit(name, metrics, table, logger)
            position.unit += 1
            self.progress.advance(phase.progress, headline(self.latest), seconds)
            if time.monotonic() - saved >= self.config.checkpoint_interval:
                self._save(name, phase)
                saved = time.monotonic()
        self.progress.end(position.seconds.get(name, 0.0))
        return True

    def _log_unit(
        self, name: str, metrics: Mapping[str, float], table: MetricsTable, logger: RunLogger
    ) -> None:
        position = self.position
        named = {key: float(value) for key, value in metrics.items() if key != REAL_STEPS}
        seconds = round(sum(position.seconds.values()), 3)
        row = {
            "phase": name,
            "unit": position.unit,
            REAL_STEPS: position.real_steps,
            "seconds": seconds,
            **named,
        }
        self.latest |= named
        table.append(row)
        try:
            logger.log(row, position.unit)
            for label, path in getattr(self.phases[name], "new_files", ()):
                log = logger.log_agent if path.is_dir() else logger.log_file
                log(label, path, position.unit)
        except Exception as error:  # a logger must never end a run
            _log.warning(
                "%s could not log unit %d: %s", type(logger).__name__, position.unit, error
            )

    def _note_warnings(self) -> None:
        known = self.record.metadata.get("warnings", [])
        if new := [text for text in self.warned.texts if text not in known]:
            self.record.metadata["warnings"] = [*known, *new]
            self.record.write()

    def _finish(self, name: str, phase: Phase) -> None:
        self._save(name, phase, self.directory.phase(name))
        clear_rotation(self.directory.rotation)
        self._note(name, phase)
        self.record.write()

    def _note(self, name: str, phase: Phase) -> None:
        position = self.position
        self.record.note(name, phase, seconds=position.seconds, steps=position.real_steps)

    def _state(self, name: str, phase: Phase) -> dict[str, Any]:
        return {
            "phase": name,
            "trainer": phase.state_dict(),
            "random": GlobalRNGState().state_dict(),
            "position": vars(self.position),
            **self.record.state_dict(),
        }

    def _save(self, name: str, phase: Phase, path: Path | None = None) -> None:
        self.keeper.save(self._state(name, phase), self.position.unit, path)

    def _resume_phase(self, name: str, phase: Phase) -> None:
        """Continue from the newest checkpoint of this phase, if it has one."""
        found = load_latest(self.directory.rotation, metadata=self.origin)
        # A checkpoint of an earlier phase was outlived by that phase's final state.
        if found is not None and found[1].get("phase") == name:
            # Random states also where it was done but not yet finished: it is saved once more.
            self._restore(phase, found[1], ours=True, random_states=True)

    def _restore(
        self, phase: Phase, state: Mapping[str, Any], *, ours: bool, random_states: bool = False
    ) -> None:
        """Take over a state, of this run or (``ours`` false) of the one it begins from."""
        if ours:
            self.record.load_state_dict(state)
        try:
            phase.load_state_dict(state["trainer"])
            self.position = _Position(**state["position"])
            if random_states:
                GlobalRNGState().load_state_dict(state["random"])
        except Exception as error:  # a hostile state may fail in any way
            raise CheckpointError(
                f"{self.directory.path}: its checkpoint of phase {state.get('phase')!r} does not "
                f"fit its config.yaml: {error}"
            ) from error
        if ours and phase.done:
            self._note(state["phase"], phase)

    def _open_logs(self) -> tuple[MetricsTable, RunLogger]:
        unit, metadata = self.position.unit, self.record.metadata
        table = self.record.open_table(unit)
        logger = make_logger(
            self.config.logger,
            self.config.to_mapping(),
            self.directory.path,
            run_id=metadata.get("logger_id"),
            resume_unit=unit if metadata.get("sessions") else None,
            rows=table.rows,
        )
        metadata["logger_id"] = logger.id or metadata.get("logger_id")
        metadata.setdefault("sessions", []).append(
            {**describe_origin(self.config.seed), "first_unit": unit}
        )
        self.record.write()
        return table, logger


def _seed_everything(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)
