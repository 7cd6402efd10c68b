"""The episode of a run's page: the moving picture, and states, actions and rewards over time."""

from __future__ import annotations

import base64
import csv
import math
from itertools import pairwise
from pathlib import Path

from phihp_torchrl.display import Series, chart, figure
from phihp_torchrl.evaluation import EVERY

_ABOUT = (
    '<span class="key">the episode</span> <span class="key model">the model</span> '
    '<span class="key command">action</span> <span class="key third">reward</span>'
)
_ABOUT_MODEL = (
    f"The model predicts {EVERY} steps from the actions alone, and begins anew at the state of the "
    "episode. Where both lines are one, it is right."
)
_PREDICTED = "predicted "


def episode(path: Path) -> str:
    """The episode of the run in a directory; nothing where none was played.

    Args:
        path: directory of the run.
    """
    table = path / "episode.csv"
    if not table.is_file():
        return ""
    with table.open(newline="", encoding="utf-8") as file:
        columns = _columns(list(csv.reader(file)))
    time = columns.pop("time")
    predicted = {k: columns.pop(k) for k in [*columns] if k.startswith(_PREDICTED)}
    time_known = [t for t in time if t is not None]
    names = list(columns)
    states = [k for k in names if columns[k][-1] is not None]  # actions have no last row
    figures = ""
    for name in names:
        values = columns[name]
        if name in states:
            lines = [Series(time, _with_gaps(values), "line", "measured")]
            if (foreseen := predicted.get(_PREDICTED + name)) is not None:
                lines.append(_pieces(time_known, values, foreseen))
        elif name == "reward":
            lines = [Series(time, values, "line", "third")]
        else:
            lines = [Series(time, values, "steps", "command")]
        known = [v for v in values if v is not None]
        alt = f"{name} over time, from {min(known):.3g} to {max(known):.3g}."
        figures += figure(chart(lines, alt, "time (s)", name))
    about = f"<p>{_ABOUT}</p>\n" + (f"<p>{_ABOUT_MODEL}</p>\n" if predicted else "")
    return _picture(path) + about + f'<div class="charts">{figures}</div>\n'


def _picture(path: Path) -> str:
    """The moving picture, in the page itself; nothing where the world draws none."""
    gif = path / "episode.gif"
    if not gif.is_file():
        return ""
    data = base64.b64encode(gif.read_bytes()).decode()
    return f'<p><img alt="The episode, moving." src="data:image/gif;base64,{data}"></p>\n'


def _columns(rows: list[list[str]]) -> dict[str, list[float | None]]:
    head, *body = rows
    columns: dict[str, list[float | None]] = {}
    for name, *texts in zip(head, *body, strict=True):
        values = [float(text) if text else None for text in texts]
        columns[name] = [v if v is not None and math.isfinite(v) else None for v in values]
    return columns


def _with_gaps(values: list[float | None]) -> list[float | None]:
    """No line is drawn where an angle passes π."""
    kept = values[:1]
    for before, now in pairwise(values):
        jumps = before is not None and now is not None and abs(now - before) > math.pi
        kept.append(None if jumps else now)
    return kept


def _pieces(time: list[float], values: list[float | None], foreseen: list[float | None]) -> Series:
    """Each prediction from the state that it began at, with a gap before it."""
    x: list[float | None] = []
    y: list[float | None] = []
    for start in range(0, len(values) - 1, EVERY):
        end = min(start + EVERY, len(values) - 1)
        x += [*time[start : end + 1], None]
        y += [*_with_gaps([values[start], *foreseen[start + 1 : end + 1]]), None]
    return Series(x, y, "line", "model")
