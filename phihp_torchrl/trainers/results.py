"""The result of a finished run, read from its directory."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from phihp_torchrl.config import METHODS
from phihp_torchrl.evaluation import BASELINES_KEY, TaskResult
from phihp_torchrl.trainers.run_directory import RunDirectory


def read_result(path: Path) -> TaskResult | None:
    """Read the returns of the agent of the run in ``path``; ``None`` if it was not evaluated.

    Raises:
        ConfigError: if there is no run in ``path``.
    """
    directory = RunDirectory(path)
    config = directory.read_config()
    if not directory.evaluation.is_file():
        return None
    results = json.loads(directory.evaluation.read_text(encoding="utf-8"))
    results.pop(BASELINES_KEY, None)  # they are not what was learned
    if not results:  # a world in which nobody can act
        return None
    means = {name: (result["return_mean"],) for name, result in results.items()}
    samples = directory.read_metadata()["real_steps"]
    method = METHODS.get(config.get("method", "phihp"))
    label = config["method"] if method is None else method.label
    world = (config.get("world") or {}).get("kind", "simulated")
    # Targets and published returns are for simulated worlds only.
    task = config["task"] if world == "simulated" else f"{config['task']} in {world}"
    return TaskResult(task, samples, label=label, **means)


def read_controllers(path: Path) -> dict[str, dict[str, Any]] | None:
    """Read what the run's agent and the baselines earned, by name; ``None`` without baselines.

    Args:
        path: directory of the run.
    """
    directory = RunDirectory(path)
    if not directory.evaluation.is_file():
        return None
    results = json.loads(directory.evaluation.read_text(encoding="utf-8"))
    beside = results.pop(BASELINES_KEY, None)
    return None if beside is None else {**results, **beside}
