"""The files of a run, from which it can be read, repeated and resumed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from torchrl.checkpoint import CheckpointRotation

from phihp_torchrl.config import ConfigError, digest_of, sealed, unsealed
from phihp_torchrl.trainers.files import write_atomically
from phihp_torchrl.trainers.stored import read_stored

# What runs did before there were these settings, whose defaults are others.
_BEFORE = {
    ("model", "fit", "shuffle_actions"): False,
    ("policy", "refit", "interval"): 0,
    ("policy", "extension"): 0.0,
    ("policy", "planned"): 0.0,
}


class RunDirectory:
    """The directory of a run, and the paths of its files.

    ========================= =====================================================================
    ``config.yaml``           the whole configuration
    ``metadata.json``         seed, commit, command, machine, versions, seconds of each phase,
                              and settings, task and code that the run was started with
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
        return _complete(read_stored(self.config))

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Write the configuration, as YAML."""
        write_atomically(self.config, OmegaConf.to_yaml(OmegaConf.create(dict(config))))

    def read_metadata(self) -> dict[str, Any]:
        """Read the metadata; empty if there are none.

        Raises:
            ConfigError: if they were damaged or edited.
        """
        try:
            return unsealed(self.metadata.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError) as error:
            raise ConfigError(str(self.metadata), f"cannot be read: {error}") from error

    def write_metadata(self, metadata: Mapping[str, Any]) -> None:
        """Write the origin and the duration of the run, as JSON with its digest."""
        write_atomically(self.metadata, sealed(metadata))

    def read_evaluation(self) -> dict[str, Any] | None:
        """Read what the agent and the baselines earned; ``None`` if it was not evaluated.

        Raises:
            ConfigError: if the file was damaged or edited, or was not written to its end.
        """
        try:
            text = self.evaluation.read_text(encoding="utf-8")
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise ConfigError(str(self.evaluation), f"cannot be read: {error}") from error
        expected = (self.read_metadata().get("digests") or {}).get(self.evaluation.name)
        try:
            if expected is not None and digest_of(text) != expected:
                raise ValueError("its digest is another: it was damaged or edited")
            results = json.loads(text)
            if not isinstance(results, dict):
                raise ValueError(f"expected a JSON object, got {type(results).__name__}")
        except (ValueError, RecursionError) as error:
            raise ConfigError(
                str(self.evaluation),
                f"cannot be read: {error}. Resuming the run writes it again: resume={self.path}.",
            ) from error
        return results

    @property
    def is_begun(self) -> bool:
        """Whether the run has done anything that would be lost with its directory."""
        checkpoints = self.rotation.directory.glob(f"{self.rotation.prefix}-*")
        return any(checkpoints) or any((self.path / "phases").glob("*"))


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
