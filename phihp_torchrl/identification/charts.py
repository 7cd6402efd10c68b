"""Pictures of an identification: predictions beside measurements, and what a fit leaves over."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from html import escape

from phihp_torchrl.display import Numbers, Series, chart, figure, thin
from phihp_torchrl.identification.parts import Residuals, Rollout
from phihp_torchrl.identification.result import Identification

_DOTS = 350
_BINS = 10
_FEWEST = 5
"""Residuals in a bin that has a mean."""


def rollout_charts(found: Identification) -> str:
    """Each held-out prediction: a chart for each measured state, and one for each action."""
    return "".join(_rollout(found, i, each) for i, each in enumerate(found.rollouts, 1))


def _rollout(found: Identification, number: int, rollout: Rollout) -> str:
    origin = rollout.time[max(rollout.begin - 1, 0)]
    time = [t - origin for t in rollout.time]
    ahead = len(time) - rollout.begin
    figures = []
    for name, measured in rollout.measured.items():
        if all(v is None for v in measured):
            continue
        alt = (
            f"{name} over time: measured, and predicted for {ahead} steps"
            f"{_largest(measured[rollout.begin :], rollout.predicted[name][rollout.begin :])}."
        )
        lines = [
            Series(time, measured, "dots", "measured"),
            Series(time, rollout.predicted[name], "line", "model"),
        ]
        label = with_unit(found, name)
        figures.append(figure(chart(lines, alt, "time (s)", label, shade_from=0.0)))
    for name, command in rollout.action.items():
        line = Series(time, command, "steps", "command")
        alt = f"The command {name} over time."
        label = with_unit(found, name)
        figures.append(figure(chart([line], alt, "time (s)", label, shade_from=0.0)))
    where = ", which meets a stop" if rollout.at_stop else ""
    title = f"{number}. {escape(rollout.source)}, episode {rollout.episode}, from {origin:.4g} s"
    return f'<h3>{title}{where}</h3>\n<div class="charts">{"".join(figures)}</div>\n'


def _largest(measured: Numbers, predicted: Sequence[float]) -> str:
    errors = [abs(a - b) for a, b in zip(measured, predicted, strict=True) if a is not None]
    return f", at most {max(errors):.3g} apart" if errors else ""


def residual_charts(found: Identification) -> str:
    """Residuals of each measured state against states, commands, commands before, and each other.

    The line in a cloud of dots is the mean of each tenth of them.
    """
    left = found.residuals
    return "" if left is None else "".join(_of_state(found, left, name) for name in left.residual)


def _of_state(found: Identification, left: Residuals, name: str) -> str:
    residual = left.residual[name]
    noise = found.noise.get(name) or 0.0
    reach = _reach(residual, noise)
    label = f"residual of {name}{_unit(found, name)}"
    kinds = {"state": left.state, "command": left.action, "command before": left.previous}
    figures = []
    for kind, columns in kinds.items():
        for other, values in columns.items():
            lines = _cloud(values, residual, -reach, reach)
            alt = f"Residuals of {name} against {other}. {_trend(lines[1].y, noise)}"
            x_label = other if kind == "command before" else with_unit(found, other)
            svg = chart(lines, alt, x_label, label, band=noise, y_range=(-reach, reach))
            figures.append(figure(svg, f"against the {kind} {other}" if kind != "command before"
                                   else f"against {other}"))  # fmt: skip
    white = left.autocorrelation.get(name)
    if white:
        figures.append(_whiteness(name, white))
    return f'<h3>{escape(name)}</h3>\n<div class="charts">{"".join(figures)}</div>\n'


def _reach(residual: Numbers, noise: float) -> float:
    """Half the height of the charts: nearly all residuals, so that few do not hide the others."""
    sizes = sorted(abs(v) for v in residual if v is not None)
    usual = sizes[int(0.99 * (len(sizes) - 1))] if sizes else 0.0
    return 1.3 * max(usual, noise) or 1.0


def _cloud(x: Sequence[float], y: Numbers, low: float, high: float) -> list[Series]:
    pairs = [(a, b) for a, b in zip(x, y, strict=True) if b is not None]
    shown = [pairs[i] for i in thin(len(pairs), _DOTS)]
    left, right = (min(x), max(x)) if x else (0.0, 1.0)
    bins: list[list[float]] = [[] for _ in range(_BINS)]
    for a, b in pairs:
        share = (a - left) / (right - left) if right > left else 0.0
        bins[min(int(share * _BINS), _BINS - 1)].append(min(max(b, low), high))
    middles = [left + (right - left) * (i + 0.5) / _BINS for i in range(_BINS)]
    kept = [(m, statistics.fmean(b)) for m, b in zip(middles, bins, strict=True)
            if len(b) >= _FEWEST]  # fmt: skip
    return [
        Series([a for a, _ in shown], [b for _, b in shown], "dots", "soft"),
        Series([a for a, _ in kept], [b for _, b in kept], "line", "model"),
    ]


def _trend(means: Numbers, noise: float) -> str:
    largest = max((abs(v) for v in means if v is not None), default=0.0)
    return f"Means of tenths reach {largest / noise:.2g} times the noise." if noise else ""


def _whiteness(name: str, white: Sequence[float]) -> str:
    lags = [float(k) for k in range(1, len(white) + 1)]
    bars = [Series(lags, white, "bars", "model")]
    alt = (
        f"Correlation of residuals of {name} that are 1 to {len(white)} samples apart: "
        f"{', '.join(f'{v:.2f}' for v in white)}."
    )
    svg = chart(bars, alt, "samples apart", "correlation", y_range=(-1.0, 1.0))
    return figure(svg, "against those before: white noise has no correlation")


def with_unit(found: Identification, name: str) -> str:
    """A name with its unit, if that is known."""
    return name + _unit(found, name)


def _unit(found: Identification, name: str) -> str:
    unit = found.units.get(name)
    return f" ({unit})" if unit else ""
