"""The loop over the phases of a run, and over the units of work of each."""

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

from phihp_torchrl.config import resolve_seconds
from phihp_torchrl.display import Progress
from phihp_torchrl.dynamics import HybridDynamics, PreparedModel
from phihp_torchrl.origin import describe_origin
from phihp_torchrl.trainers.checkpoints import clear_rotation, load_latest, load_state
from phihp_torchrl.trainers.compile_ahead import CompileAhead, compiles_ahead
from phihp_torchrl.trainers.compile_choice import earned, earned_by_step
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.finite import check_finite
from phihp_torchrl.trainers.headline import headline
from phihp_torchrl.trainers.interrupt import Abandoned, Interrupt
from phihp_torchrl.trainers.keeper import Keeper
from phihp_torchrl.trainers.loggers import REAL_STEPS, RunLogger, make_logger
from phihp_torchrl.trainers.metrics_table import MetricsTable
from phihp_torchrl.trainers.phases import PHASES, Phase, real_steps
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.run_record import RunRecord
from phihp_torchrl.trainers.warned import Warned
from phihp_torchrl.worlds import World

_log = logging.getLogger(__name__)


@dataclass
class _Position:
    """The progress of a run, which is part of every checkpoint."""

    unit: int  # units of work done, over all phases; also the rows of metrics.csv
    real_steps: int
    seconds: dict[str, float]  # by phase


class RunLoop:
    """Makes the phases of a run one after the other, and works through the units of each.

    A phase that was finished before is restored, and one that was begun goes on from its last
    checkpoint.

    Args:
        config: settings of the run.
        world: the real world.
        directory: directory of the run, which is this process's.
        interrupt: catches the signals that stop a run.
        progress: shows how far it is.
        warned: the warnings that were logged.
    """

    latest: dict[str, float]
    """The last value of every metric that this process logged."""

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
        self.latest = {}
        self.record = RunRecord(directory)

    def run(self) -> bool:
        """Do all phases; false if a signal ended it early."""
        table, logger, finished = None, RunLogger(), True
        ahead = self._compile_ahead()
        try:
            for name in (*self.config.phases_before, *self.config.phases_to_do):
                _seed_everything(self.config.seed)
                if ahead is not None and name == "policy":
                    self._wait_for(ahead)
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
            if ahead is not None:
                ahead.end()
        if table is None and finished:  # everything was done before
            self.record.complete(self.phases, self.position.unit)
        return finished

    def _make_phase(self, name: str) -> Phase:
        world = self.world
        for phase in self.phases.values():  # one may have found out more of the world's task
            known = getattr(phase, "world", None)
            world = known if isinstance(known, World) else world
        settings = resolve_seconds(self.config.section(name), world.task.time_step)
        self._compile_step(name, world)
        compiled = self._compiles(name, settings, world)
        context = Context(
            config=self.config,
            settings=settings,
            task=world.task,
            world=world,
            before=dict(self.phases),
            directory=self.directory,
            compile=compiled,
        )
        return PHASES[name].build(context)

    def _compiles(self, name: str, settings: Any, world: World) -> bool:
        """Whether a phase is compiled; what was chosen once is kept, and said."""
        if isinstance(self.config.compile, bool):
            return self.config.compile
        chosen = self.record.metadata.setdefault("compiled", {})
        if name not in chosen:
            step = bool(chosen.get("step"))
            found = earned(self.config, name, settings, world, step=step)
            chosen[name] = found.pays
            if found.taken and name in self.config.phases_to_do:
                self.progress.say(found.words(name))
        return bool(chosen[name])

    def _compile_ahead(self) -> CompileAhead | None:
        """Let another process compile the policy phase, if the model is to be learned before."""
        config = self.config
        if self.directory.phase("model").exists() or not compiles_ahead(config, self.world):
            return None
        settings = resolve_seconds(config.section("policy"), self.world.task.time_step)
        if not self._compiles("policy", settings, self.world):
            return None
        ahead = CompileAhead(config, self.world)
        if ahead.is_at_work:
            self.progress.say("Another process compiles the policy phase meanwhile.")
        return ahead

    def _wait_for(self, ahead: CompileAhead) -> None:
        """Wait for what is compiled ahead, if it is still of use; that is time of the policy."""
        start = time.monotonic()
        if ahead.still_fits(self.phases["model"]):
            with self.interrupt.work():
                ahead.wait()
        else:
            ahead.end()
        self.position.seconds["policy"] = time.monotonic() - start

    def _compile_step(self, name: str, world: World) -> None:
        """Compile the step of the model alone where phases that are not compiled earn it."""
        dynamics = getattr(self.phases.get("model"), "dynamics", None)
        if self.config.compile != "auto" or not isinstance(dynamics, HybridDynamics):
            return
        chosen = self.record.metadata.setdefault("compiled", {})
        if "step" not in chosen:
            to_do = self.config.phases_to_do
            left = to_do[to_do.index(name) :] if name in to_do else to_do
            operations = PreparedModel(world.task, dynamics, torch.empty(0)).operations
            found = earned_by_step(self.config, left, world, operations)
            chosen["step"] = found.pays
            if found.pays:
                self.progress.say(found.words("a step of the model"))
        if chosen["step"]:
            dynamics.compile_step()

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
