"""Work on one cell: skip, resume, run, keep; never twice, and no error lost."""

from __future__ import annotations

import json
import logging
import shutil
import socket
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
from hydra.core.global_hydra import GlobalHydra

from grid.cell import CellFiles
from grid.claim import claim
from grid.committed import check_committed, check_sessions
from grid.config import GridConfig
from grid.keep import fingerprint, has_fingerprint, is_whole, keep, keep_failure
from grid.status import CellState, Status, is_done, look
from measures import configuration_hash
from phihp_torchrl.config import ConfigError, compose_yaml, override_lines
from phihp_torchrl.origin import source_commit
from phihp_torchrl.trainers import RunDirectory, RunRequest, read_request, run

_log = logging.getLogger(__name__)
_LOGGERS = ("phihp_torchrl", "grid")


def work(config: GridConfig, root: Path) -> CellState:
    """Bring a cell to its end, unless it is there or another process is at it.

    Args:
        config: the cell.
        root: directory that relative ones are in.

    Returns:
        Its state, with ``only_plan`` as it is found. An error of the run is a state too: it ends
        this cell, not the grid.

    Raises:
        ConfigError: if the code is not that of a commit, unless ``allow_dirty``; if the cell is
            there of other settings, as when a default has changed since; and for a proof, if the
            cell is there, or was begun, of another commit.
        KeyboardInterrupt: if a signal asked the run to stop; its checkpoint is written.
    """
    if not config.allow_dirty:
        check_committed()
    files = config.files(root)
    if config.only_plan:
        return look(files)
    if not (is_done(files) and is_whole(files)):
        with claim(files.lock, config.claim_wait) as ours:
            # Only now: another process may have finished the cell, or failed at it, meanwhile.
            if ours:
                _check_proof(config, files)
            if ours and is_done(files):
                if not is_whole(files):
                    keep(files)
            elif ours and (config.retry_failed or not files.failure.is_file()):
                with _logged(files.log):
                    _run(config, files)
    state = look(files)
    if state.status is Status.DONE:
        _check_proof(config, files)
    # A cell whose settings an earlier version did not fingerprint is taken as it is.
    if state.status is Status.DONE and has_fingerprint(files):
        _check_settings(config, files.kept)
    return state


def _check_settings(config: GridConfig, folder: Path) -> None:
    """Refuse a run, or what is kept of it, whose settings the same words no longer give."""
    then = fingerprint(folder)
    now = configuration_hash(_read(list(config.words())).config.to_mapping())
    if then != now:
        raise ConfigError(
            str(folder),
            f"expected a run of the present settings ({now}), got one of others ({then}). Give "
            "the grid another `results` and another `runs`, or move the cell and its run away.",
        )


def _check_proof(config: GridConfig, files: CellFiles) -> None:
    """Refuse a proof of which a part, finished or only begun, was made by another commit's code."""
    if config.proof:
        check_sessions(files.kept)
        if RunDirectory(files.run).is_begun:  # else it starts afresh
            check_sessions(files.run)


def _check_evaluation(config: GridConfig, settings: Mapping[str, Any]) -> None:
    """Refuse a run that would play others' episodes, and a proof that hangs on an idle core."""
    found = settings["evaluate"]["first_seed"]
    if found != config.first_seed:
        raise ConfigError(
            "evaluate.first_seed",
            f"expected {config.first_seed} with proof={str(config.proof).lower()}, got {found}.",
        )
    if config.proof and settings["evaluate"]["packaged"] == "auto":
        raise ConfigError("evaluate.packaged", "expected true or false with proof=true, got auto.")


def _run(config: GridConfig, files: CellFiles) -> None:
    files.failure.unlink(missing_ok=True)
    # Cells of one process share compiled code, and dynamo counts how often a function is compiled.
    torch.compiler.reset()
    try:
        request = _request(config, files)
        _check_evaluation(config, request.config.to_mapping())
        _log.info("%s", "resumed" if request.resume else "started")
        result = run(request.config, request.path, resume=request.resume)
        if result.finished:
            _check_settings(config, files.run)  # else its numbers would be kept as this cell's
            _check_proof(config, files)
            keep(files)
            _log.info("finished")
    except Exception as error:
        _log.exception("failed")
        record = {
            "error": " ".join(f"{type(error).__name__}: {error}".split()),
            "traceback": traceback.format_exc(),
            "host": socket.gethostname(),
            "when": datetime.now().astimezone().isoformat(timespec="seconds"),
            "commit": source_commit(),
        }
        files.failure.write_text(json.dumps(record, indent=2) + "\n")
        keep_failure(files, record)
        return
    if not result.finished:
        _log.info("stopped by signal %s", result.signal)
        raise KeyboardInterrupt


def _request(config: GridConfig, files: CellFiles) -> RunRequest:
    """What ``phihp train`` would be asked for.

    The words hold for a resumed run too, which refuses to be another one than it was.
    """
    place, directory = "resume", RunDirectory(files.run)
    if not directory.config.is_file() or not directory.is_begun:
        # Killed or failed before its first checkpoint: there is nothing to lose in it, and its
        # settings may be others now.
        shutil.rmtree(files.run, ignore_errors=True)
        place = "run_dir"
    words = [*config.words(), *override_lines({place: str(files.run)})]
    return _read(words)


def _read(words: list[str]) -> RunRequest:
    with _no_hydra():
        return read_request(compose_yaml(words), words)


@contextmanager
def _no_hydra() -> Iterator[None]:
    """Hydra knows one application at a time: set the grid's aside while a run's is composed."""
    instance = GlobalHydra.instance()
    outer = instance.hydra
    instance.clear()
    try:
        yield
    finally:
        instance = GlobalHydra.instance()
        instance.clear()
        if outer is not None:
            instance.initialize(outer)


@contextmanager
def _logged(path: Path) -> Iterator[None]:
    """All messages of the package and of the grid go to ``path``, and none to the terminal."""
    loggers = [logging.getLogger(name) for name in _LOGGERS]
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    before = [(logger.level, logger.propagate) for logger in loggers]
    for logger in loggers:
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
        logger.propagate = False
    try:
        yield
    finally:
        for logger, (level, propagate) in zip(loggers, before, strict=True):
            logger.setLevel(level)
            logger.propagate = propagate
            logger.removeHandler(handler)
        handler.close()
