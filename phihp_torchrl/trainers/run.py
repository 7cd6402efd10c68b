"""A run: the phases of a method one after the other, logged, checkpointed and resumable."""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.checkpoint import CheckpointError, GlobalRNGState
from tqdm.auto import tqdm

from phihp_torchrl.config import ConfigError, resolve_seconds
from phihp_torchrl.deployment import plain_defaults
from phihp_torchrl.origin import describe_origin
from phihp_torchrl.trainers.checkpoints import (
    clear_rotation,
    load_latest,
    load_state,
    save_state,
)
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.interrupt import Interrupt
from phihp_torchrl.trainers.loggers import REAL_STEPS, RunLogger, make_logger
from phihp_torchrl.trainers.phases import PHASES, Phase, real_steps
from phihp_torchrl.trainers.rehearsal import rehearse
from phihp_torchrl.trainers.run_checks import check_run
from phihp_torchrl.trainers.run_config import RunConfig, task_of
from phihp_torchrl.trainers.run_directory import MetricsTable, RunDirectory
from phihp_torchrl.trainers.start import check_same, start_directory
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
        ConfigError: before any real step, if the directory holds another run, or ``config`` differs
            from that of the run to resume.
        CheckpointError: if no checkpoint of the run can be read.

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
    else:
        rehearse(config, world)
        config, directory = start_directory(config, path)
    with Interrupt() as interrupt:
        return _Run(config, world, directory, interrupt).run()


class _Run:
    """The loop over phases, and over the units of each."""

    def __init__(
        self, config: RunConfig, world: World, directory: RunDirectory, interrupt: Interrupt
    ) -> None:
        self.config = config
        self.world = world
        self.directory = directory
        self.interrupt = interrupt
        self.origin = {"task": config.task}
        self.phases: dict[str, Phase] = {}
        self.position = _Position(0, 0, {})
        self.latest: dict[str, float] = {}

    def run(self) -> RunResult:
        metadata = self.directory.read_metadata()
        table, logger, finished = None, RunLogger(), True
        try:
            for name in (*self.config.phases_before, *self.config.phases_to_do):
                _seed_everything(self.config.seed)
                phase = self._make_phase(name)
                self.phases[name] = phase
                if self.directory.phase(name).exists():
                    self._restore(
                        phase, load_state(self.directory.phase(name), metadata=self.origin)
                    )
                    continue
                self._resume_phase(name, phase)
                if hasattr(phase, "keep"):
                    phase.keep = partial(self._save, name, phase)
                if table is None:
                    table, logger = self._open_logs(metadata)
                finished = self._advance(name, phase, table, logger)
                if not finished:
                    break
                self._finish(name, phase, metadata)
        finally:
            logger.close()
        return RunResult(self.directory.path, finished, self.interrupt.signal, self.latest)

    def _make_phase(self, name: str) -> Phase:
        world = self.world
        for phase in self.phases.values():  # one may have found out more of the world's task
            known = getattr(phase, "world", None)
            world = known if isinstance(known, World) else world
        context = Context(
            config=self.config,
            settings=resolve_seconds(self.config.section(name), world.task.time_step),
            task=world.task,
            world=world,
            before=dict(self.phases),
            directory=self.directory,
        )
        return PHASES[name].build(context)

    def _advance(self, name: str, phase: Phase, table: MetricsTable, logger: RunLogger) -> bool:
        """Work through a phase; false if a signal ended it early."""
        position, saved = self.position, time.monotonic()
        done, total = phase.progress
        hidden = None if self.config.progress else True  # None: shown on a terminal alone
        with tqdm(
            desc=name, initial=done, total=total, unit=f" {PHASES[name].unit}", disable=hidden
        ) as bar:
            while not phase.done:
                if self.interrupt:
                    self._save(name, phase)
                    return False
                start = time.monotonic()
                metrics = phase.advance()
                position.seconds[name] = position.seconds.get(name, 0.0) + time.monotonic() - start
                position.real_steps = real_steps(self.phases)
                self._log_unit(name, metrics, table, logger)
                position.unit += 1
                bar.total = phase.progress[1]
                bar.update(phase.progress[0] - bar.n)
                bar.set_postfix_str(_summary(metrics))
                if time.monotonic() - saved >= self.config.checkpoint_interval:
                    self._save(name, phase)
                    saved = time.monotonic()
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

    def _finish(self, name: str, phase: Phase, metadata: dict[str, Any]) -> None:
        self._save(name, phase, self.directory.phase(name))
        clear_rotation(self.directory.rotation)
        metadata["seconds"] = {k: round(v, 3) for k, v in self.position.seconds.items()}
        metadata["real_steps"] = self.position.real_steps
        if hasattr(phase, "summary"):
            metadata[name] = phase.summary
        self.directory.write_metadata(metadata)

    def _save(self, name: str, phase: Phase, path: Path | None = None) -> None:
        state = {
            "phase": name,
            "trainer": phase.state_dict(),
            "random": GlobalRNGState().state_dict(),
            "position": vars(self.position),
        }
        place = path or self.directory.rotation
        save_state(place, state, metadata=self.origin, step=self.position.unit)

    def _resume_phase(self, name: str, phase: Phase) -> None:
        """Continue from the newest checkpoint of this phase, if it has one."""
        found = load_latest(self.directory.rotation, metadata=self.origin)
        # A checkpoint of an earlier phase was outlived by that phase's final state.
        if found is not None and found[1].get("phase") == name:
            self._restore(phase, found[1])
            GlobalRNGState().load_state_dict(found[1]["random"])

    def _restore(self, phase: Phase, state: Mapping[str, Any]) -> None:
        try:
            phase.load_state_dict(state["trainer"])
            self.position = _Position(**state["position"])
        except Exception as error:  # a hostile state may fail in any way
            raise CheckpointError(
                f"{self.directory.path}: its checkpoint of phase {state.get('phase')!r} does not "
                f"fit its config.yaml: {error}"
            ) from error

    def _open_logs(self, metadata: dict[str, Any]) -> tuple[MetricsTable, RunLogger]:
        unit = self.position.unit
        table = MetricsTable(self.directory.metrics, rows=unit)
        resumed = bool(metadata.get("sessions"))
        logger = make_logger(
            self.config.logger,
            self.config.to_mapping(),
            self.directory.path,
            run_id=metadata.get("logger_id"),
            resume_unit=unit if resumed else None,
        )
        metadata["logger_id"] = logger.id or metadata.get("logger_id")
        metadata.setdefault("sessions", []).append(
            {**describe_origin(self.config.seed), "first_unit": unit}
        )
        self.directory.write_metadata(metadata)
        return table, logger


def _seed_everything(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def _summary(metrics: Mapping[str, float]) -> str:
    """Format the returns among the metrics, or else the errors and losses."""
    for words in (("return",), ("error", "loss")):
        chosen = {k: v for k, v in metrics.items() if any(word in k for word in words)}
        if chosen:
            return ", ".join(f"{k} {v:.4g}" for k, v in list(chosen.items())[:2])
    return ""
