"""What is kept of a finished run: small text files, enough for every table and figure."""

from __future__ import annotations

import csv
import json
import logging
import os
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from grid.cell import Cell, CellFiles
from grid.claim import claim
from grid.planned import read_cells
from measures import configuration_hash, curve_from_metrics, prediction_errors, write_curve
from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment import Agent, load_agent
from phihp_torchrl.evaluation import PROOF_SEED
from phihp_torchrl.trainers import write_atomically
from phihp_torchrl.worlds import SimulatedWorld, make_world

_log = logging.getLogger(__name__)

CELL = "cell.json"
CURVE = "curve.csv"
PREDICTION = "prediction.json"
_COPIED = ("config.yaml", "metadata.json", "metrics.csv")


def keep(files: CellFiles) -> None:
    """Copy the small files of a finished run, and derive what they do not say.

    ``evaluation.json`` comes last, for it marks the cell as done. Called again, it adds what an
    earlier version did not write.
    """
    files.kept.mkdir(parents=True, exist_ok=True)
    for name in _COPIED:
        _replace(files.run / name, files.kept / name)
    with (files.run / "metrics.csv").open(newline="") as file:
        points = curve_from_metrics(csv.DictReader(file))
    write_curve(files.run / CURVE, points)
    _replace(files.run / CURVE, files.kept / CURVE)
    cell = {
        **asdict(files.cell),
        "configuration": fingerprint(files.run),
        "proof": _settings(files.run)["evaluate"].get("first_seed") == PROOF_SEED,
    }
    (files.run / CELL).write_text(json.dumps(cell, indent=2) + "\n")
    _replace(files.run / CELL, files.kept / CELL)
    _keep_prediction(files)
    _replace(files.run / "evaluation.json", files.evaluation)
    files.kept_failure.unlink(missing_ok=True)


def keep_failure(files: CellFiles, record: Mapping[str, Any]) -> None:
    """Keep in short how a cell failed, for a report to say why its number is missing.

    The file goes when the cell has been tried again and is done.
    """
    files.kept.mkdir(parents=True, exist_ok=True)
    short = {key: record[key] for key in ("error", "when", "commit")}
    write_atomically(files.kept_failure, json.dumps(short, indent=2) + "\n")


_WAIT = 60.0
"""Seconds for other processes to write their plan."""


def keep_names(cells: Sequence[CellFiles]) -> None:
    """Add the cells that a grid was asked for to ``planned.json``, by their names.

    With it a report can say how many of the planned cells there are, and which are missing.

    Raises:
        ConfigError: for an earlier ``planned.json`` that cannot be read, or that other processes
            write for a minute.
    """
    named = defaultdict[Path, dict[str, Cell]](dict)
    for files in cells:
        named[files.planned][files.cell.name] = files.cell
    for planned, asked in named.items():
        # Beside the file, which grids of several clones may share.
        with claim(planned.with_name(f".{planned.name}.lock"), wait=_WAIT) as ours:
            if not ours:
                raise ConfigError(
                    "results", f"expected to write {planned}, another process holds its lock."
                )
            before = read_cells(planned, "results")
            if asked.keys() <= before.keys():
                continue
            planned.parent.mkdir(parents=True, exist_ok=True)
            every = {name: asdict(one) for name, one in sorted({**before, **asked}.items())}
            write_atomically(planned, json.dumps(every, indent=2) + "\n")


def fingerprint(folder: Path) -> str:
    """That of the settings of a run, or of what is kept of it."""
    return configuration_hash(_settings(folder))


def has_fingerprint(files: CellFiles) -> bool:
    """Whether the version that kept a cell wrote the fingerprint of its settings."""
    cell = files.kept / CELL
    return cell.is_file() and "configuration" in json.loads(cell.read_text())


def is_whole(files: CellFiles) -> bool:
    """Whether everything is kept that can still be had."""
    can_be_had = {CELL, CURVE} if (files.run / "evaluation.json").is_file() else set()
    if (files.run / "agent").is_dir():
        can_be_had.add(PREDICTION)
    return all((files.kept / name).is_file() for name in can_be_had)


def _settings(folder: Path) -> dict[str, Any]:
    settings: dict[str, Any] = yaml.safe_load((folder / "config.yaml").read_text())
    return settings


def _keep_prediction(files: CellFiles) -> None:
    """The errors of the run's model on states it has not seen, where it has a model."""
    if not (files.run / "agent").is_dir():
        return
    try:
        errors = _prediction_errors(load_agent(files.run / "agent", packaged=False))
    except Exception as error:  # a finished run must not be lost to an afterthought
        _log.warning("%s: its model's predictions were not measured: %s", files.run, error)
        return
    (files.run / PREDICTION).write_text(json.dumps(errors, indent=2) + "\n")
    _replace(files.run / PREDICTION, files.kept / PREDICTION)


def _prediction_errors(agent: Agent) -> dict[str, float]:
    """None for an agent without a model, and in a world whose truth nobody knows."""
    settings = (agent.metadata.get("config") or {}).get("world") or "simulated"
    kind = settings if isinstance(settings, str) else settings.get("kind")
    if agent.dynamics is None or kind != SimulatedWorld.kind:
        return {}
    world = make_world(agent.task, settings)
    assert isinstance(world, SimulatedWorld)  # by its kind
    return prediction_errors(world, agent.dynamics)


def _replace(source: Path, target: Path) -> None:
    """Copy in one step: readers see the old file or the new."""
    stage = target.with_name(f".{target.name}.stage")
    shutil.copyfile(source, stage)
    os.replace(stage, target)
