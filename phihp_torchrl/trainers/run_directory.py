"""The files of a run, from which it can be read, repeated and resumed."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from torchrl.checkpoint import CheckpointRotation
from yaml import YAMLError

from phihp_torchrl.config import ConfigError
from phihp_torchrl.trainers.yaml_file import read_yaml

# What runs did before there were these settings, whose defaults are others.
_BEFORE = {
    ("model", "fit", "shuffle_actions"): False,
    ("policy", "refit", "interval"): 0,
    ("policy", "refit", "start"): 0,
}


class RunDirectory:
    """The directory of a run, and the paths of its files.

    ========================= =====================================================================
    ``config.yaml``           the whole configuration
    ``metadata.json``         seed, commit, command, machine, versions, seconds of each phase
    ``metrics.csv``           a row for each unit of work
    ``checkpoints/``          the latest states of the current phase
    ``phases/<phase>/``       the final state of each finished phase
    ``agent/``, ``episode.*`` results of the last phase: the agent, a figure and a GIF
    ========================= =====================================================================

    Args:
        path: the directory.
        keep_checkpoints: number of checkpoints that are kept.
    """

    def __init__(self, path: str | Path, keep_checkpoints: int = 2) -> None:
        self.path = Path(path)
        self.config = self.path / "config.yaml"
        self.metadata = self.path / "metadata.json"
        self.metrics = self.path / "metrics.csv"
        self.agent = self.path / "agent"
        self.evaluation = self.path / "evaluation.json"
        self.rotation = CheckpointRotation(
            self.path / "checkpoints", keep_last=keep_checkpoints, prefix="unit"
        )

    def phase(self, name: str) -> Path:
        """Return the path of the final state of a phase."""
        return self.path / "phases" / name

    def read_config(self) -> dict[str, Any]:
        """Read the configuration with which the run was started.

        Raises:
            ConfigError: if this is no run directory, or its configuration cannot be read.
        """
        if not self.config.is_file():
            raise ConfigError(str(self.path), "not the directory of a run, it has no config.yaml.")
        try:
            config = read_yaml(self.config)
        except (YAMLError, OSError, ValueError) as error:
            raise ConfigError(str(self.config), f"cannot be read: {error}") from error
        if not isinstance(config, dict):
            raise ConfigError(str(self.config), f"expected keys and values, got {config!r}.")
        return _complete(config)

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Write the configuration, as YAML."""
        write_atomically(self.config, OmegaConf.to_yaml(OmegaConf.create(dict(config))))

    def read_metadata(self) -> dict[str, Any]:
        """Read the metadata; empty if there are none."""
        try:
            return json.loads(self.metadata.read_text())
        except FileNotFoundError:
            return {}
        except ValueError as error:
            raise ConfigError(str(self.metadata), f"cannot be read: {error}") from error

    def write_metadata(self, metadata: Mapping[str, Any]) -> None:
        """Write the origin and the duration of the run, as JSON."""
        write_atomically(self.metadata, json.dumps(metadata, indent=2) + "\n")


def _complete(config: dict[str, Any]) -> dict[str, Any]:
    """Add to the sections of an older run the settings that say what it did without them."""
    config.setdefault("calibrate", {"enabled": False})
    for (phase, *path), value in _BEFORE.items():
        section: Any = config.get(phase)
        for key in path[:-1] if isinstance(section, dict) else ():
            section = section.setdefault(key, {})
        if isinstance(section, dict):
            section.setdefault(path[-1], value)
    return config


def new_run_directory(task: str, label: str) -> Path:
    """Make ``outputs/<task>/<time>-<label>``, with a number if that exists."""
    parent = Path("outputs") / task
    parent.mkdir(parents=True, exist_ok=True)
    name = f"{datetime.now():%Y-%m-%d_%H-%M-%S}-{label}"
    for number in range(1, 1000):
        path = parent / (name if number == 1 else f"{name}-{number}")
        try:
            path.mkdir()
        except FileExistsError:
            continue
        return path
    raise ConfigError("run_dir", f"{parent / name} and 998 more are taken; name one.")


def write_atomically(path: Path, text: str) -> None:
    """Replace the file at ``path`` in one step: readers see the old text or the new."""
    stage = path.with_name(f".{path.name}.stage")
    stage.write_text(text)
    os.replace(stage, path)


class MetricsTable:
    """A CSV file with a row for each unit of work; new metrics become new columns.

    Args:
        path: the file.
        rows: number of rows to keep of an existing file: those before the checkpoint from which the
            run is resumed. Later rows are computed again.

    Examples:
        >>> import tempfile
        >>> table = MetricsTable(Path(tempfile.mkdtemp()) / "metrics.csv")
        >>> table.append({"unit": 0, "loss": 1.5})
        >>> table.append({"unit": 1, "return": -300.0})
        >>> print(table.path.read_text())
        unit,loss,return
        0,1.5,
        1,,-300.0
        <BLANKLINE>
    """

    def __init__(self, path: Path, rows: int = 0) -> None:
        self.path = path
        self._columns: list[str] = []
        kept: list[dict[str, str]] = []
        if rows and path.exists():
            with path.open(newline="") as file:
                reader = csv.DictReader(file)
                kept = [row for _, row in zip(range(rows), reader, strict=False)]
                # Drop columns of later rows only; they are added again with those rows.
                columns = reader.fieldnames or []
                self._columns = [c for c in columns if any(row[c] for row in kept)]
        self._write(kept)

    def append(self, row: Mapping[str, Any]) -> None:
        """Add a row."""
        if new := [name for name in row if name not in self._columns]:
            with self.path.open(newline="") as file:
                old = list(csv.DictReader(file))
            self._columns += new
            self._write(old)
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns, lineterminator="\n").writerow(row)

    def _write(self, rows: list[dict[str, str]]) -> None:
        stage = self.path.with_name(f".{self.path.name}.stage")
        with stage.open("w", newline="") as file:
            if self._columns:
                writer = csv.DictWriter(
                    file, self._columns, lineterminator="\n", extrasaction="ignore"
                )
                writer.writeheader()
                writer.writerows(rows)
        os.replace(stage, self.path)
