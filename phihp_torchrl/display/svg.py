"""Charts as SVG inside a page: without a script, a font or a file, in the colours of the page."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

_WIDTH, _HEIGHT = 340.0, 190.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 62.0, 14.0, 8.0, 36.0

Numbers = Sequence[float | None]


@dataclass(frozen=True)
class Series:
    """Values over others, drawn in one way.

    Args:
        x: places; ``None`` leaves a gap.
        y: values, as many.
        kind: ``"line"``, ``"steps"`` (each value holds until the next), ``"dots"`` or ``"bars"``.
        color: a class of the page's style: ``"measured"``, ``"model"``, ``"command"`` or
            ``"third"``.
    """

    x: Numbers
    y: Numbers
    kind: Literal["line", "steps", "dots", "bars"]
    color: str


@dataclass(frozen=True)
class _Axis:
    """From values to places on the paper."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)


def chart(
    series: Sequence[Series],
    alt: str,
    x_label: str,
    y_label: str,
    *,
    shade_from: float | None = None,
    band: float | None = None,
    y_range: tuple[float, float] | None = None,
) -> str:
    """A chart with axes.

    Args:
        series: what is drawn, from below to above.
        alt: what one sees, in words, for those who cannot.
        x_label: text below the horizontal axis.
        y_label: text above the vertical one.
        shade_from: where a shaded part of the horizontal axis begins, which ends at its end.
        band: half the height of a shaded band around zero.
        y_range: ends of the vertical axis; by default those of the values.

    Examples:
        >>> svg = chart([Series([0, 1], [2, 3], "line", "model")], "A line.", "time", "angle")
        >>> svg.startswith('<svg class="chart" role="img" aria-label="A line."')
        True
    """
    bars = any(s.kind == "bars" for s in series)
    across = _axis([v for s in series for v in s.x], _LEFT, _WIDTH - _RIGHT, pad=0.6 * bars)
    values = [v for s in series for v in s.y] if y_range is None else list(y_range)
    up = _axis([*values, 0.0] if bars else values, _HEIGHT - _BOTTOM, _TOP, share=0.05)
    parts = []
    if shade_from is not None:
        parts.append(_box(across(shade_from), _TOP, _WIDTH - _RIGHT, _HEIGHT - _BOTTOM))
    if band is not None:
        top, bottom = (min(max(up(v), _TOP), _HEIGHT - _BOTTOM) for v in (band, -band))
        parts.append(_box(_LEFT, top, _WIDTH - _RIGHT, bottom))
    parts += [*_grid(across, up, bars), *_labels(x_label, y_label)]
    parts += [_draw(s, across, up) for s in series]
    return (
        f'<svg class="chart" role="img" aria-label="{escape(alt)}" '
        f'viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}">{"".join(parts)}</svg>'
    )


def interval_bar(guess: float, estimate: float, low: float | None, high: float | None) -> str:
    """An estimate with its interval, and the first guess, on one scale; for a cell of a table.

    Examples:
        >>> "<rect" in interval_bar(1.0, 1.2, 1.1, 1.3), "<rect" in interval_bar(1, 1, 1, 1)
        (True, True)
        >>> "<rect" in interval_bar(1.0, 1.2, None, None)
        False
    """
    ends = (low, high) if low is not None and high is not None else (None, None)
    place = _axis([guess, estimate, *ends], 8.0, 152.0)
    parts = ['<line class="grid" x1="2" x2="158" y1="12" y2="12"/>']
    words = f"First guess {guess:.4g}, estimate {estimate:.4g}"
    if ends[0] is not None and ends[1] is not None:
        a, b = place(ends[0]), place(ends[1])
        left, width = (a + b - max(b - a, 3.0)) / 2, max(b - a, 3.0)
        parts.append(
            f'<rect class="interval" x="{left:.1f}" y="7" width="{width:.1f}" height="10" rx="2"/>'
        )
        words += f", 95 % interval {ends[0]:.4g} to {ends[1]:.4g}"
    else:
        words += ", no interval"
    at, begun = place(estimate), place(guess)
    parts.append(f'<circle class="guess" cx="{begun:.1f}" cy="12" r="5"/>')
    parts.append(f'<circle class="estimate" cx="{at:.1f}" cy="12" r="3"/>')
    return (
        f'<svg class="bar" role="img" aria-label="{words}." viewBox="0 0 160 24">'
        f"{''.join(parts)}</svg>"
    )


def figure(svg: str, caption: str = "") -> str:
    """A picture with a caption, plain text.

    Examples:
        >>> print(figure("<svg></svg>", "a < b"), end="")
        <figure><svg></svg><figcaption>a &lt; b</figcaption></figure>
    """
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{svg}{below}</figure>\n"


def thin(count: int, most: int) -> list[int]:
    """Places of at most so many of ``count`` entries, at equal distances.

    Examples:
        >>> thin(5, 3), thin(2, 3)
        ([0, 2, 4], [0, 1])
    """
    if count <= most:
        return list(range(count))
    return [round(i * (count - 1) / (most - 1)) for i in range(most)]


def _axis(
    values: Numbers, start: float, end: float, *, share: float = 0.0, pad: float = 0.0
) -> _Axis:
    """An axis that holds all values, with room beside them: a share of their range, or a length."""
    known = [v for v in values if v is not None and math.isfinite(v)]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    room = (high - low) * share + pad
    if high + room <= low - room:
        room = 0.5 * abs(high) or 0.5
    return _Axis(low - room, high + room, start, end)


def _ticks(axis: _Axis, count: int, whole: bool = False) -> list[tuple[float, str]]:
    from matplotlib.ticker import MaxNLocator  # here, for most of this folder has to be there early

    values = MaxNLocator(nbins=count, integer=whole).tick_values(axis.low, axis.high)
    inside = [float(v) for v in values if axis.low <= v <= axis.high]
    step = min((b - a for a, b in itertools.pairwise(inside)), default=1.0)
    return [(v, f"{0.0 if abs(v) < 1e-6 * step else v:.6g}") for v in inside]


def _grid(across: _Axis, up: _Axis, whole: bool) -> list[str]:
    parts = []
    bottom, right = _HEIGHT - _BOTTOM, _WIDTH - _RIGHT
    for value, text in _ticks(up, 5):
        y = up(value)
        kind = "axis" if value == 0 else "grid"
        parts.append(f'<line class="{kind}" x1="{_LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 5}" y="{y + 3.5:.1f}" text-anchor="end">{text}</text>')
    for value, text in _ticks(across, 5, whole):
        x = across(value)
        parts.append(
            f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{bottom}" y2="{bottom + 4}"/>'
        )
        parts.append(f'<text x="{x:.1f}" y="{bottom + 15}" text-anchor="middle">{text}</text>')
    parts.append(f'<line class="axis" x1="{_LEFT}" x2="{right}" y1="{bottom}" y2="{bottom}"/>')
    return parts


def _labels(x_label: str, y_label: str) -> list[str]:
    middle = (_TOP + _HEIGHT - _BOTTOM) / 2
    return [
        f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{_HEIGHT - 4}" text-anchor="middle">'
        f"{escape(x_label)}</text>",
        f'<text transform="translate(10 {middle}) rotate(-90)" text-anchor="middle">'
        f"{escape(y_label)}</text>",
    ]


def _box(left: float, top: float, right: float, bottom: float) -> str:
    return (
        f'<rect class="shade" x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}" '
        f'height="{bottom - top:.1f}"/>'
    )


def _draw(series: Series, across: _Axis, up: _Axis) -> str:
    low, high = sorted((up.start, up.end))
    points = [
        None if x is None or y is None else (across(x), min(max(up(y), low), high))
        for x, y in zip(series.x, series.y, strict=True)
    ]
    if series.kind == "dots":
        path = "".join(f"M{p[0]:.1f} {p[1]:.1f}h0" for p in points if p)
    elif series.kind == "bars":
        path = "".join(f"M{p[0]:.1f} {up(0.0):.1f}V{p[1]:.1f}" for p in points if p)
    else:
        pieces: list[str] = []
        held = series.kind == "steps"
        before = None
        for p in points:
            if p is not None and before is None:
                pieces.append(f"M{p[0]:.1f} {p[1]:.1f}")
            elif p is not None:
                pieces.append(f"H{p[0]:.1f}V{p[1]:.1f}" if held else f"L{p[0]:.1f} {p[1]:.1f}")
            before = p
        path = "".join(pieces)
    return f'<path class="{series.kind} {series.color}" d="{path}"/>'
