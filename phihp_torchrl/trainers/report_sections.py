"""The sections of the page of a run."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from phihp_torchrl.config import ConfigError, differences, flatten, load_config
from phihp_torchrl.display import Cell, Series, chart, duration, facts, figure, number, said, table
from phihp_torchrl.evaluation import BASELINES_KEY, PUBLISHED, TARGETS
from phihp_torchrl.origin import commit_text, machine_text
from phihp_torchrl.trainers.next_steps import next_steps
from phihp_torchrl.trainers.report_episode import episode as episode
from phihp_torchrl.trainers.return_curve import COLLECTING, return_curve

Rows = list[dict[str, str]]
_PRIVATE = ("from", "phases", "progress", "checkpoint_interval", "keep_checkpoints", "logger")
"""Settings that change no result."""
_ABOUT_RESULT = (
    "Returns of episodes from seeds that no training has used, the same for every row: mean with "
    "its standard error, the worst and the best. Chatter is the mean change of the action from "
    "step to step in the second half, as a share of its half-range; the time is that of one action."
)
_ABOUT_RETURNS = (
    "A point for each collection is what its steps were worth: the mean return of its episodes, "
    "or the mean reward times the steps of an episode where none was terminated. Those steps "
    "serve to learn, and not to earn. The agent at the end played episodes of its own."
)
_ABOUT_IMAGINED = (
    "Mean return of the noise-free actor after each stretch of training, in the model, and in the "
    "world where that is simulated. The world's returns are for this picture alone: the actor that "
    "is kept is the one with the best return in the model."
)
_ABOUT_MODEL = (
    "Errors on real steps that took no part in the fit, after each collection, as powers of ten: "
    "the distance after 20 steps from the actions alone, in raw units of the state, and the mean "
    "square of one step in units of a step."
)
_ABOUT_CONSTANTS = (
    "Constants of the equations, and what the motion determines of them, as the first fit left "
    "them and as the last one did."
)
_ABOUT_SETTINGS = "By the task's defaults for this method, those of the preset <em>default</em>."


def last(rows: Rows, name: str) -> float | None:
    """The last value of a metric; ``None`` without one."""
    return next((float(row[name]) for row in reversed(rows) if row.get(name)), None)


def result(config: Mapping[str, Any], results: Mapping[str, Any]) -> str:
    """Every controller that played, and what was to be reached."""
    words = {"planner": "the agent, planning", "actor": "the actor alone"}
    played = {words.get(k, k): v for k, v in results.items() if k != BASELINES_KEY}
    beside = {f"{k}, by hand": v for k, v in results.get(BASELINES_KEY, {}).items()}
    rows = []
    for name, of in {**played, **beside}.items():
        returns = of["returns"]
        error = statistics.stdev(returns) / math.sqrt(len(returns)) if len(returns) > 1 else None
        mean = statistics.fmean(returns)
        spread = "" if error is None else f" ± {number(error, 2)}"
        rows.append(
            [
                Cell(escape(name), head=True),
                Cell(f"{number(mean)}{spread}", "number"),
                Cell(number(min(returns)), "number"),
                Cell(number(max(returns)), "number"),
                Cell(number(of.get("chatter"), 2), "number"),
                Cell(number(of.get("latency_ms_p50"), 2), "number"),
            ]
        )
    if not rows:
        return ""
    head = ("controller", "return", "worst", "best", "chatter", "ms an action")
    return said(_ABOUT_RESULT, table(head, rows, "Controllers", "stack") + _published(config))


def _published(config: Mapping[str, Any]) -> str:
    """What the paper's runs earned, in a simulated world and for a method of the paper."""
    kind = (config.get("world") or {}).get("kind", "simulated")
    paper = PUBLISHED.get(config["task"], {}).get("PhIHP")
    if kind != "simulated" or paper is None:
        return ""
    target = TARGETS.get(config["task"])
    ours = "" if target is None else f" This package set out to reach {number(target)}."
    samples = "" if paper.samples is None else f" from {1000 * paper.samples:.0f} real steps"
    told = f"{number(paper.return_mean)} ± {number(paper.return_std)}"
    return f"<p>The paper has {told} for PhIHP{samples}.{ours}</p>\n"


def returns(rows: Rows) -> str:
    """Return over real steps, and over updates."""
    curve = return_curve(rows)
    html = ""
    if curve:
        colors = {COLLECTING: "measured", "while learning": "model", "the actor alone": "command"}
        lines, keys, told = [], [], []
        for words, points in curve.items():
            color, alone = colors.get(words, "third"), len(points) == 1
            x, y = [float(a) for a, _ in points], [b for _, b in points]
            lines.append(Series(x, y, "dots" if alone else "line", color))
            keys.append(f'<span class="key {color}">{escape(words)}</span>')
            told.append(f"{words}: {number(y[0])} to {number(y[-1])}")
        # One point of nothing makes the axis begin at no steps.
        lines.append(Series([0.0], [None], "dots", "measured"))
        svg = chart(lines, f"Return over real steps. {'; '.join(told)}.", "real steps", "return")
        html = said(_ABOUT_RETURNS, f"<p>{' '.join(keys)}</p>\n{_charts(figure(svg))}")
    return html + _imagined(rows)


def _charts(figures: str) -> str:
    return f'<div class="charts">{figures}</div>\n'


def _column(rows: Rows, x: str, y: str) -> tuple[list[float], list[float]]:
    pairs = [(float(row[x]), float(row[y])) for row in rows if row.get(x) and row.get(y)]
    kept = [(a, b) for a, b in pairs if math.isfinite(b)]
    return [a for a, _ in kept], [b for _, b in kept]


def _imagined(rows: Rows) -> str:
    lines, keys = [], []
    for name, words, color in (
        ("policy/imagined_return", "in the model", "model"),
        ("policy/real_return", "in the world", "third"),
    ):
        x, y = _column(rows, "policy/updates", name)
        if x:
            lines.append(Series(x, y, "line", color))
            keys.append(f'<span class="key {color}">{words}</span>')
    if not lines:
        return ""
    end = f"The last return in the model is {number(last(rows, 'policy/imagined_return'))}."
    svg = chart(lines, f"Returns over updates. {end}", "critic updates", "return")
    told = f"<p>{_ABOUT_IMAGINED}</p>\n<p>{' '.join(keys)}</p>\n"
    return f"<h3>While it trained in imagination</h3>\n{told}{_charts(figure(svg))}"


def model(rows: Rows) -> str:
    """Errors of the model over real steps."""
    figures = ""
    for name, words in (
        ("model/rollout_error_20", "error 20 steps ahead"),
        ("model/held_out_error", "held-out error of one step"),
    ):
        x, y = _column(rows, "real_steps", name)
        if x:
            powers = [math.log10(v) if v > 0 else None for v in y]
            told = f"{words}: {number(y[0], 2)} at first, {number(y[-1], 2)} last"
            alt = f"Over real steps, the {told}."
            line = Series(x, powers, "line" if len(x) > 1 else "dots", "model")
            svg = chart([line], alt, "real steps", "power of ten")
            figures += figure(svg, told)
    return said(_ABOUT_MODEL, _charts(figures)) if figures else ""


def learned(rows: Rows, metadata: Mapping[str, Any], truth: Mapping[str, float] | None) -> str:
    """The constants of the equations, and what a phase says of itself."""
    start = "constants/"
    names = [k.removeprefix(start) for k in (rows[0] if rows else {}) if k.startswith(start)]
    cells = []
    for name in names:
        values = [float(row[start + name]) for row in rows if row.get(start + name)]
        true = (truth or {}).get(name)
        off = "" if not true else f"{100 * abs(values[-1] / true - 1):.2g} %"
        cells.append(
            [
                Cell(escape(name), head=True),
                Cell(number(values[0], 5), "number"),
                Cell(number(values[-1], 5), "number"),
                *([Cell(number(true, 5), "number"), Cell(off, "number")] if truth else []),
            ]
        )
    head = ["constant", "first fit", "last fit", *(["true", "off by"] if truth else [])]
    html = said(_ABOUT_CONSTANTS, table(head, cells, "Learned constants", "stack")) if cells else ""
    share = last(rows, "model/residual_share")
    if share is not None:
        html += (
            f"<p>The network that the equations lack makes {100 * share:.2g} % of the motion: its "
            "part of ds/dt beside that of the equations, over the real steps.</p>\n"
        )
    for phase in metadata.get("seconds", {}):
        if isinstance(summary := metadata.get(phase), dict):
            html += f"<h3>{escape(phase)}</h3>\n{facts(summary)}"
    return html


def settings(config: Mapping[str, Any]) -> str:
    """The settings that differ from the task's defaults."""
    method = config.get("method", "phihp")
    try:
        usual = load_config(config["task"], method=method)
    except ConfigError:
        return "<p>The task's defaults are not known here.</p>\n"
    known = {k: v for k, v in usual.items() if k in config and k not in _PRIVATE}
    ours = {k: config[k] for k in known}
    different = differences(flatten(ours), flatten(known))
    if not different:
        return "<p>None: these are the defaults.</p>\n"
    cells = [
        [Cell(escape(key), head=True), Cell(escape(_text(a))), Cell(escape(_text(b)))]
        for key, a, b in different
    ]
    return said(_ABOUT_SETTINGS, table(("setting", "here", "default"), cells, "Settings"))


def _text(value: Any) -> str:
    return json.dumps(value) if not isinstance(value, str) else value


def origin(metadata: Mapping[str, Any]) -> str:
    """Where the numbers come from, and what they took."""
    times = {f"{name}": duration(s) for name, s in metadata.get("seconds", {}).items()}
    sessions = metadata.get("sessions") or []
    if not sessions:
        return facts(times)
    session = sessions[0]
    commit = {} if session.get("commit") is None else {"commit": commit_text(session)}
    told = {
        "time": times,
        "started": session["started"],
        "command": " ".join(session["command"]),
        **commit,
        "machine": f"{session['machine']['system']}, {machine_text(session)}",
        "versions": session["versions"],
    }
    if len(sessions) > 1:
        told["resumed"] = f"{len(sessions) - 1} times"
    return facts(told)


def following(path: Path) -> str:
    """What one does next, as commands."""
    return "".join(
        f'<p>To {escape(what)}:</p>\n<pre tabindex="0">{escape(command)}</pre>\n'
        for what, command in next_steps(path)
    )
