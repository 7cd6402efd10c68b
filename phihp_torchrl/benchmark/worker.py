"""Work on one cell: skip, resume, run, keep; never twice, and no error lost."""

from __future__ import annotations

import json
import logging
import shutil
import socket
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from phihp_torchrl.benchmark.cell import CellFiles
from phihp_torchrl.benchmark.claim import claim
from phihp_torchrl.benchmark.config import BenchmarkConfig
from phihp_torchrl.benchmark.keep import is_whole, keep
from phihp_torchrl.benchmark.status import CellState, Status, look
from phihp_torchrl.trainers import RunRequest, read_request, run

_log = logging.getLogger(__name__)


def work(config: BenchmarkConfig, recipes: Path, root: Path) -> CellState:
    """Bring a cell to its end, unless it is there or another process is at it.

    Args:
        config: the cell.
        recipes: directory of the recipes' configurations.
        root: directory that relative ones are in.

    Returns:
        Its state. An error of the run is a state too: it ends this cell, not the grid.

    Raises:
        KeyboardInterrupt: if a signal asked the run to stop; its checkpoint is written.
    """
    files = config.files(root)
    if look(files).status is Status.DONE and is_whole(files):
        return look(files)
    with claim(files.lock, config.claim_wait) as ours:
        # Only now: another process may have finished the cell, or failed at it, meanwhile.
        if ours and files.evaluation.is_file():
            if not is_whole(files):
                keep(files)
        elif ours and (config.retry_failed or not files.failure.is_file()):
            with _logged(files.log):
                _run(config, files, recipes)
    return look(files)


def _run(config: BenchmarkConfig, files: CellFiles, recipes: Path) -> None:
    files.failure.unlink(missing_ok=True)
    # Cells of one process share compiled code, and dynamo counts how often a function is compiled.
    torch.compiler.reset()
    try:
        request = _request(config, files, recipes)
        _log.info("%s", "resumed" if request.resume else "started")
        result = run(request.config, request.path, resume=request.resume)
        if result.finished:
            keep(files)
            _log.info("finished")
    except Exception as error:
        _log.exception("failed")
        record = {
            "error": " ".join(f"{type(error).__name__}: {error}".split()),
            "traceback": traceback.format_exc(),
            "host": socket.gethostname(),
            "when": datetime.now().astimezone().isoformat(timespec="seconds"),
        }
        files.failure.write_text(json.dumps(record, indent=2) + "\n")
        return
    if not result.finished:
        _log.info("stopped by signal %s", result.signal)
        raise KeyboardInterrupt


def _request(config: BenchmarkConfig, files: CellFiles, recipes: Path) -> RunRequest:
    """What ``python recipes/<recipe>.py`` would be asked for."""
    cell, how = files.cell, config.how
    lines = [f"task={cell.task}", f"seed={cell.seed}", "progress=false"]
    if cell.samples is not None:
        lines.append(f"{how.samples_key}={cell.samples}")
    # Overrides hold for a resumed run too, which refuses to be another one than it was.
    lines += [*how.overrides, *config.overrides]
    if (files.run / "config.yaml").is_file():
        lines.append(f"resume={_quoted(files.run)}")
    else:
        # Killed before its first file was whole: there is nothing to lose in it.
        shutil.rmtree(files.run, ignore_errors=True)
        lines.append(f"run_dir={_quoted(files.run)}")
    with _no_hydra(), initialize_config_dir(str(recipes), version_base="1.3"):
        return read_request(compose(how.recipe, lines), lines)


def _quoted(path: Path) -> str:
    text = str(path).replace("\\", "\\\\").replace("'", "\\'")
    return f"'{text}'"


@contextmanager
def _no_hydra() -> Iterator[None]:
    """Hydra knows one application at a time: set the grid's aside while a recipe's is composed."""
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
    """All messages of the package go to ``path``, and none to the terminal."""
    logger = logging.getLogger("phihp_torchrl")
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    before = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
    try:
        yield
    finally:
        logger.setLevel(before[0])
        logger.propagate = before[1]
        logger.removeHandler(handler)
        handler.close()
