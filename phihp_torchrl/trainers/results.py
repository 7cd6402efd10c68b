"""The result of a finished run, read from its directory."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from phihp_torchrl.config import METHODS
from phihp_torchrl.evaluation import BASELINES_KEY, TaskResult
from phihp_torchrl.trainers.return_curve import read_rows
from phihp_torchrl.trainers.run_directory import RunDirectory


def read_result(path: Path) -> TaskResult | None:
    """Read the returns of the agent of the run in ``path``; ``None`` if it was not evaluated.

    Raises:
        ConfigError: if there is no run in ``path``, or its evaluation was not written to its end.
    """
    directory = RunDirectory(path)
    config = directory.read_config()
    results = directory.read_evaluation()
    if results is None:
        return None
    results.pop(BASELINES_KEY, None)  # they are not what was learned
    if not results:  # a world in which nobody can act
        return None
    means = {
        name: (math.nan if (mean := result["return_mean"]) is None else mean,)
        for name, result in results.items()
    }
    samples = directory.read_metadata()["real_steps"]
    method = METHODS.get(config.get("method", "phihp"))
    label = config["method"] if method is None else method.label
    world = (config.get("world") or {}).get("kind", "simulated")
    # Targets and published returns are for simulated worlds only.
    task = config["task"] if world == "simulated" else f"{config['task']} in {world}"
    return TaskResult(task, samples, label=label, **means)


def read_learned(path: Path) -> str | None:
    """A sentence on the model of the run in ``path``: its constants, and its error; or ``None``.

    Args:
        path: directory of the run.
    """
    last: dict[str, str] = {}
    for row in read_rows(RunDirectory(path).metrics):
        last |= {name: value for name, value in row.items() if value}
    start = "constants/"
    names = [name.removeprefix(start) for name in last if name.startswith(start)]
    parts = [", ".join(f"{name} {float(last[start + name]):.4g}" for name in names)]
    if (error := last.get("model/rollout_error_20")) is not None:
        parts.append(f"an error of {float(error):.2g} after 20 steps that it was not fitted to")
    told = "; ".join(part for part in parts if part)
    return f"The model has learned {told}." if names else None


def read_controllers(path: Path) -> dict[str, dict[str, Any]] | None:
    """Read what the run's agent and the baselines earned, by name; ``None`` without baselines.

    Args:
        path: directory of the run.
    """
    directory = RunDirectory(path)
    results = directory.read_evaluation()
    if results is None:
        return None
    beside = results.pop(BASELINES_KEY, None)
    return None if beside is None else {**results, **beside}
