"""The runs behind a report, from their folders; a folder that is not fit is named, not fatal."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml

from grid.cell import DEFAULT_METHOD
from grid.status import read_failure
from measures import CurvePoint, configuration_hash, curve_from_metrics, read_curve
from phihp_torchrl.evaluation import BASELINES_KEY, EVALUATION_SEED
from phihp_torchrl.origin import commit_text, machine_text

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # a report reads hundreds of files


@dataclass(frozen=True)
class Acting:
    """What one way of acting earned in the last phase of a run.

    Args:
        returns: return of every episode.
        latency: milliseconds for an action, by statistic (``"p50"``, …); empty if not measured.
    """

    returns: tuple[float, ...]
    latency: Mapping[str, float]

    @property
    def mean(self) -> float:
        """Mean return."""
        return sum(self.returns) / len(self.returns)


@dataclass(frozen=True)
class Run:
    """A finished run.

    Args:
        folder: where it was read from.
        method: name of its method.
        task: name of its task, with the world's where it is not the simulated one.
        label: name of its settings.
        preset: the preset that they begin with.
        samples: real samples it was given.
        seed: its seed.
        kind: kind of its model; ``None`` for a method without one.
        configuration: fingerprint of its settings, equal for runs that differ by their seed alone.
        commit: abbreviated, with a ``+`` if the source had been changed, when it was begun.
        commits: abbreviated, of all its sessions: a run that was resumed may have several.
        dirty: whether the source had been changed in any session; ``None`` where that of one is
            unknown and no other was.
        first_seed: the seed of the episodes that it was evaluated in.
        threads: how many it computed with.
        machine: what it ran on.
        seconds: time of each phase.
        acting: by way of acting, ``"planner"`` or ``"actor"``.
        curve: its evaluations in the real world, in their order.
        prediction: errors of its model on states it had not seen; empty if not measured.
    """

    folder: Path
    method: str
    task: str
    label: str
    preset: str
    samples: int
    seed: int
    kind: str | None
    configuration: str
    commit: str
    commits: tuple[str, ...]
    dirty: bool | None
    first_seed: int
    threads: int
    machine: str
    seconds: Mapping[str, float]
    acting: Mapping[str, Acting]
    curve: tuple[CurvePoint, ...]
    prediction: Mapping[str, float]

    @property
    def core_hours(self) -> float:
        """Its recorded time, times its threads."""
        return sum(self.seconds.values()) * self.threads / 3600


@dataclass(frozen=True)
class RunFolders:
    """What a directory of runs holds.

    Args:
        runs: the finished runs.
        problems: a sentence for each folder that was left out, with its name.
    """

    runs: tuple[Run, ...]
    problems: tuple[str, ...]


def read_runs(directory: Path, *, any_version: bool = False) -> RunFolders:
    """Read all runs in ``directory``.

    Args:
        directory: it has a folder for each run.
        any_version: take runs of other versions of this package too.
    """
    if not directory.is_dir():
        return RunFolders((), (f"{directory}: expected a directory of runs, there is none.",))
    runs, problems = [], []
    for folder in sorted(path for path in directory.iterdir() if path.is_dir()):
        try:
            runs.append(read_run(folder, any_version=any_version))
        except (OSError, ValueError, KeyError, TypeError, AttributeError, yaml.YAMLError) as error:
            words = " ".join(str(error).split())
            if isinstance(error, KeyError):
                words = f"it does not say {words}"
            problems.append(words if str(folder) in words else f"{folder}: left out: {words}")
    if not runs and not problems:
        problems.append(f"{directory}: no runs in it yet.")
    return RunFolders(tuple(runs), tuple(problems))


def read_run(folder: Path, *, any_version: bool = False) -> Run:
    """Read the run in ``folder``.

    Raises:
        ValueError: if it is half written, of another version, or has returns that are no numbers.
    """
    if missing := [n for n in ("config.yaml", "metadata.json", "evaluation.json", "metrics.csv")
                   if not (folder / n).is_file()]:  # fmt: skip
        if (failure := folder / "failure.json").is_file():
            raise ValueError(f"the run failed: {read_failure(failure)}")
        raise ValueError(f"the run is not finished: {', '.join(missing)} is missing.")
    config = yaml.load((folder / "config.yaml").read_text(), Loader=_LOADER)
    metadata = _read_json(folder / "metadata.json")
    cell = _read_json(folder / "cell.json") if (folder / "cell.json").is_file() else {}
    session = metadata["sessions"][0]
    if not any_version:
        _check_version(session["versions"]["phihp_torchrl"])
    method, task = config.get("method", DEFAULT_METHOD), config["task"]
    world = (config.get("world") or {}).get("kind", "simulated")
    kind = (config.get("model") or {}).get("kind")
    label = cell.get("label") or _label(folder.name, task, method)
    if method == "dd-phihp" and kind != "data_driven":
        raise ValueError(f"model.kind: expected 'data_driven' for {method}, got {kind!r}.")
    return Run(
        folder=folder,
        method=method,
        # Published returns and bounds are of the simulated worlds.
        task=task if world == "simulated" else f"{task} in {world}",
        label=label,
        preset=str(config.get("preset") or "default"),
        samples=int(cell.get("samples") or metadata["real_steps"]),
        seed=int(config["seed"]),
        kind=kind,
        configuration=configuration_hash({**config, "method": method}),
        commit=commit_text(session),
        commits=tuple(sorted({str(one["commit"])[:7] for one in metadata["sessions"]})),
        dirty=_dirty([one.get("dirty") for one in metadata["sessions"]]),
        # What runs of earlier versions do not say was the same for all of them.
        first_seed=int((config.get("evaluate") or {}).get("first_seed", EVALUATION_SEED)),
        threads=int(config.get("threads") or 1),
        machine=machine_text(session),
        seconds={str(k): float(v) for k, v in metadata["seconds"].items()},
        acting=_acting(_read_json(folder / "evaluation.json")),
        curve=_curve(folder),
        prediction=_numbers(folder / "prediction.json"),
    )


def _dirty(sessions: Sequence[bool | None]) -> bool | None:
    return True if any(sessions) else None if None in sessions else False


def _read_json(path: Path) -> dict[str, Any]:
    content = json.loads(path.read_text())
    if not isinstance(content, dict):
        raise ValueError(f"{path.name}: expected a JSON object.")
    return content


def _check_version(found: str) -> None:
    try:
        ours = version("phihp_torchrl")
    except PackageNotFoundError:
        return
    if found != ours:
        raise ValueError(
            f"the run was made by phihp_torchrl {found}, this is {ours}; any_version=true takes it."
        )


def _label(name: str, task: str, method: str) -> str:
    """The label in a cell's name, for runs from before there was a file that says it."""
    rest = name.removeprefix(f"{task}-").removeprefix(f"{method}-")
    found = re.fullmatch(r"(?:(.+?)-)?(?:n\d+-)?seed\d+", rest)
    return (found and found[1]) or "default"


def _acting(evaluation: Mapping[str, Any]) -> dict[str, Acting]:
    if not evaluation:
        raise ValueError("evaluation.json: expected returns, got none.")
    acting = {}
    for name, part in evaluation.items():
        if name == BASELINES_KEY:
            continue
        returns = tuple(float(value) for value in part["returns"])
        bad = sum(not math.isfinite(value) for value in returns)
        if bad or not returns:
            raise ValueError(
                f"evaluation.json: expected finite returns of the {name}, "
                f"{bad} of {len(returns)} are not."
            )
        start = "latency_ms_"
        latency = {k.removeprefix(start): float(v) for k, v in part.items() if k.startswith(start)}
        acting[name] = Acting(returns, latency)
    return acting


def _curve(folder: Path) -> tuple[CurvePoint, ...]:
    if (folder / "curve.csv").is_file():
        return tuple(read_curve(folder / "curve.csv"))
    with (folder / "metrics.csv").open(newline="") as file:
        return tuple(curve_from_metrics(csv.DictReader(file)))


def _numbers(path: Path) -> dict[str, float]:
    return {k: float(v) for k, v in _read_json(path).items()} if path.is_file() else {}
