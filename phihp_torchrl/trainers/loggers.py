"""Loggers for metrics, pictures and the agent, besides the run directory."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from torchrl.record.loggers import get_logger

from phihp_torchrl.config import check_fields
from phihp_torchrl.deployment import PACKAGE_FILE

_log = logging.getLogger(__name__)

REAL_STEPS = "real_steps"
"""Steps taken in the real world: the axis of all metrics."""


@dataclass(frozen=True)
class LoggerConfig:
    """Settings of the logger.

    Args:
        name: the logger, csv, wandb or tensorboard.
        project: project in wandb.
        entity: user or team in wandb; null for wandb's default.
        group: group of runs in wandb, such as the seeds of one experiment.
        tags: labels of the run in wandb.
        mode: mode of wandb, online, offline or disabled; null for the value of WANDB_MODE, or
            online.

    Examples:
        >>> from phihp_torchrl import RunConfig
        >>> RunConfig("pendulum", logger=LoggerConfig("wandb", mode="offline")).logger.project
        'phihp'
    """

    name: Literal["csv", "wandb", "tensorboard"] = "csv"
    project: str = "phihp"
    entity: str | None = None
    group: str | None = None
    tags: tuple[str, ...] = ()
    mode: Literal["online", "offline", "disabled"] | None = None

    def __post_init__(self) -> None:
        check_fields(self)


class RunLogger:
    """The csv logger, which does nothing: every run writes ``metrics.csv`` and its files."""

    id: str | None = None
    """The identifier by which a resumed run continues the same log."""

    def log(self, metrics: Mapping[str, Any], unit: int) -> None:
        """Log the metrics of one unit of work, ``real_steps`` among them."""

    def log_file(self, name: str, path: Path, unit: int) -> None:
        """Log a picture (``.png``) or a video (``.gif``)."""

    def log_agent(self, name: str, path: Path, unit: int) -> None:
        """Log the directory of an agent."""

    def close(self) -> None:
        """Write everything that is still in memory."""


class WandbRunLogger(RunLogger):
    """Logs to wandb through TorchRL's logger, with real steps as the axis of every metric."""

    def __init__(
        self,
        config: LoggerConfig,
        run: Mapping[str, Any],
        directory: Path,
        run_id: str | None,
        rows: Sequence[Mapping[str, str]] = (),
    ) -> None:
        import wandb

        options = {"entity": config.entity, "group": config.group, "tags": list(config.tags)}
        options = {key: value for key, value in options.items() if value}
        mode = {"mode": config.mode} if config.mode else {}
        self._logger = get_logger(
            "wandb",
            str(directory),
            directory.name,
            wandb_kwargs={
                "project": config.project,
                "id": run_id,
                "config": dict(run),
                "log_env_packages": False,
                # By default wandb retries for a minute and a half before it gives up.
                "settings": wandb.Settings(init_timeout=30, silent=True),
                **options,
                **mode,
            },
        )
        self._run = self._logger.experiment
        self.id = self._run.id
        self._run.define_metric(REAL_STEPS)
        self._run.define_metric("*", step_metric=REAL_STEPS)
        if getattr(self._run, "offline", False):
            # Every session has a folder of its own, and that of a killed process may hold nothing:
            # the last folder must have the whole run, for a sync replaces what came before.
            for row in rows:
                self.log({key: _number(text) for key, text in row.items()}, int(row["unit"]))

    def log(self, metrics: Mapping[str, Any], unit: int) -> None:
        # wandb ignores a unit that it has already: what a resumed run earns again is the same.
        self._run.log(dict(metrics), step=unit)

    def log_file(self, name: str, path: Path, unit: int) -> None:
        import wandb

        if path.suffix == ".png":
            self._run.log({name: wandb.Image(str(path))}, step=unit)
        else:
            self._run.log({name: wandb.Video(str(path), format="gif")}, step=unit)

    def log_agent(self, name: str, path: Path, unit: int) -> None:
        import wandb

        artifact = wandb.Artifact(name, type="agent")
        for file in sorted(path.iterdir()):
            # A package is machine code for this machine, and a dot begins what is being written.
            if file.is_file() and not file.name.startswith((PACKAGE_FILE, ".")):
                artifact.add_file(str(file))
        self._run.log_artifact(artifact)

    def close(self) -> None:
        self._run.finish()


class TensorboardRunLogger(RunLogger):
    """Logs to TensorBoard, with the unit of work as the axis and real steps as a metric."""

    def __init__(self, directory: Path, resume_unit: int | None) -> None:
        self._logger = get_logger("tensorboard", str(directory), "tensorboard")
        self._writer = self._logger.experiment
        if resume_unit is not None:
            self._forget_from(resume_unit)

    def _forget_from(self, unit: int) -> None:
        """Tell TensorBoard to drop what a killed run logged after its last checkpoint."""
        from tensorboard.compat.proto import event_pb2  # type: ignore[import-untyped]

        session = event_pb2.SessionLog(status=event_pb2.SessionLog.START)
        event = event_pb2.Event(step=unit, session_log=session)
        self._writer.file_writer.add_event(event, unit)

    def log(self, metrics: Mapping[str, Any], unit: int) -> None:
        for name, value in metrics.items():
            if isinstance(value, (int, float)):
                self._logger.log_scalar(name, value, step=unit)

    def log_file(self, name: str, path: Path, unit: int) -> None:
        if path.suffix == ".png":
            from matplotlib import pyplot

            self._writer.add_image(name, pyplot.imread(path)[..., :3], unit, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()


def make_logger(
    config: LoggerConfig,
    run: Mapping[str, Any],
    directory: Path,
    *,
    run_id: str | None = None,
    resume_unit: int | None = None,
    rows: Sequence[Mapping[str, str]] = (),
) -> RunLogger:
    """Open the logger of ``config``; if it fails, log a warning and use ``metrics.csv`` only.

    It never asks a question on the terminal.

    Args:
        config: settings of the logger.
        run: the whole configuration of the run, to be logged with it.
        directory: the run directory.
        run_id: :attr:`RunLogger.id` of the run to go on with.
        resume_unit: the first unit that will be logged, in a resumed run.
        rows: the rows of ``metrics.csv`` before it, as texts.
    """
    try:
        if config.name == "wandb":
            _check_wandb_key(config)
            return WandbRunLogger(config, run, directory, run_id, rows)
        if config.name == "tensorboard":
            return TensorboardRunLogger(directory, resume_unit)
    # A logger must never end a run, whatever its package or the network comes up with.
    except Exception as error:
        _log.warning(
            "logger=%s is not to be had (%s); metrics go to %s alone.",
            config.name,
            error,
            directory / "metrics.csv",
        )
    return RunLogger()


def _number(text: str) -> float | str:
    """The number that a cell of ``metrics.csv`` stands for, or its text."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _check_wandb_key(config: LoggerConfig) -> None:
    """Fail where wandb.init would ask for a key."""
    import wandb

    mode = config.mode or os.environ.get("WANDB_MODE", "online")
    if mode not in ("online", "run"):
        return
    try:
        known = wandb.login(prompt=False, verify=False)
    except TypeError:  # wandb before 0.2x has no `prompt`
        known = bool(wandb.api.api_key)
    if not known:
        raise RuntimeError("it has no key; log in with `wandb login`, or use logger.mode=offline")
