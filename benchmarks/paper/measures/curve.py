"""The learning curve of a run: its returns in the real world, over what they cost."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from phihp_torchrl.baselines import BASELINES

# Metrics of returns in the real world, and who earned them: first during training, then at the end.
_TRAINING = {
    "return_mean": "actor",
    "real_return": "actor",
    "actor_return": "actor",
    "planner_return": "planner",
}
# The phases whose `return_mean` is of their planner.
_PLANNERS = ("tdmpc",)
_FINAL = ("evaluate/", "/return_mean")


@dataclass(frozen=True)
class CurvePoint:
    """One evaluation in the real world.

    Args:
        phase: phase of the run.
        real_steps: steps taken in the real world until then, evaluations not counted.
        seconds: time of the run until then.
        acting: who played: ``"planner"`` or ``"actor"``.
        return_mean: mean return.
        return_std: its standard deviation over episodes; NaN where it was not logged.
        episodes: how many; NaN where it was not logged.
        updates: updates of the policy until then; NaN for a method without.
        imagined_steps: imagined transitions until then; NaN for a method without.
    """

    phase: str
    real_steps: int
    seconds: float
    acting: str
    return_mean: float
    return_std: float = math.nan
    episodes: float = math.nan
    updates: float = math.nan
    imagined_steps: float = math.nan


def last_metrics(rows: Iterable[Mapping[str, str]], names: Iterable[str]) -> dict[str, float]:
    """The last value of each of these metrics in the rows of a run's ``metrics.csv``.

    Examples:
        >>> last_metrics([{"a": "1", "b": "2"}, {"a": "3", "b": ""}], ["a", "b", "c"])
        {'a': 3.0, 'b': 2.0}
    """
    found: dict[str, float] = {}
    names = tuple(names)
    for row in rows:
        found |= {name: float(row[name]) for name in names if row.get(name)}
    return found


def curve_from_metrics(rows: Iterable[Mapping[str, str]]) -> list[CurvePoint]:
    """The curve in the rows of a run's ``metrics.csv``.

    Points are the evaluations during training, whatever the phase is called (``return_mean``,
    ``*/real_return``, ``*/actor_return``, ``*/planner_return``), and those of the last phase
    (``evaluate/*/return_mean``). What is not a finite number is left out.

    Examples:
        >>> row = {"phase": "policy", "real_steps": "500", "seconds": "7", "policy/updates": "10"}
        >>> curve_from_metrics([{**row, "policy/real_return": "-300.0"}])[0].return_mean
        -300.0
    """
    points = []
    updates = imagined = math.nan
    for row in rows:
        updates = next((_number(row, k) for k in row if k.endswith("/updates") and row[k]), updates)
        imagined = _number(row, "policy/imagined_steps", imagined)
        for acting, name in _returns(row):
            mean = _number(row, name)
            if math.isfinite(mean):
                point = CurvePoint(
                    phase=row["phase"],
                    real_steps=int(float(row["real_steps"])),
                    seconds=float(row["seconds"]),
                    acting=acting,
                    return_mean=mean,
                    return_std=_number(row, name.removesuffix("_mean") + "_std"),
                    episodes=_number(row, name.rpartition("/")[0] + "/episodes"),
                    updates=updates,
                    imagined_steps=imagined,
                )
                points.append(point)
    return points


def read_curve(path: Path) -> list[CurvePoint]:
    """Read what :func:`write_curve` wrote.

    Raises:
        ValueError: for a file of another form.
    """
    names = [f.name for f in fields(CurvePoint)]
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        if reader.fieldnames != names:
            raise ValueError(f"{path}: expected the columns {names}, got {reader.fieldnames}.")
        return [
            CurvePoint(
                phase=row["phase"],
                real_steps=int(row["real_steps"]),
                acting=row["acting"],
                **{
                    name: float(row[name] or "nan")
                    for name in names
                    if name not in ("phase", "real_steps", "acting")
                },
            )
            for row in reader
        ]


def write_curve(path: Path, points: Iterable[CurvePoint]) -> None:
    """Write a curve as CSV; what is not known stays empty."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(CurvePoint)], lineterminator="\n")
        writer.writeheader()
        for point in points:
            values = asdict(point).items()
            writer.writerow({k: "" if isinstance(v, float) and v != v else v for k, v in values})


def _returns(row: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Who played in a row, and the metric of his mean return."""
    start, end = _FINAL
    for name, value in row.items():
        if not value:
            continue
        if name.startswith(start) and name.endswith(end):
            # Baselines play beside what was learned, and are no part of its curve.
            if (played := name.removeprefix(start).removesuffix(end)) not in BASELINES:
                yield played, name
        elif not name.startswith(start) and (acting := _TRAINING.get(name.rpartition("/")[2])):
            yield "planner" if row["phase"] in _PLANNERS else acting, name


def _number(row: Mapping[str, str], name: str, default: float = math.nan) -> float:
    try:
        return float(row.get(name) or default)
    except ValueError:
        return default
