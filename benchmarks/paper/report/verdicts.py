"""How a comparison is judged: shown, not shown or refuted, with effect, interval and n."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from measures import FEWEST_SEEDS, Between, Difference, holm, ratio_interval
from report.bounds import margin
from report.cells import MIXED, is_mixed
from report.results import Score
from report.tables import NOT_RUN

LEVEL = 0.05
"""Below this p-value, adjusted by Holm, a difference counts as significant."""

SHOWN, NOT_SHOWN, REFUTED, NOT_MEASURED = "shown", "not shown", "refuted", "not measured"


class Pair(NamedTuple):
    """A comparison of mean returns, as it is tested in its family.

    Attributes:
        what: its name.
        task: whose returns they are.
        gap: the difference; ``None`` where a side has no run, or none that says it.
        seeds: of either side, as a finding has them.
        planned: whether grids were asked for both sides.
        absent: the verdict where there is no difference.
        least: the claim is that the difference is above this, which is what its p-value is of.
    """

    what: str
    task: str
    gap: Difference | None
    seeds: str
    planned: bool
    absent: str = NOT_RUN
    least: float = 0.0


@dataclass(frozen=True)
class Finding:
    """What one comparison says on a claim.

    Args:
        what: the task, or the systems and the task.
        verdict: :data:`SHOWN`, :data:`NOT_SHOWN` or :data:`REFUTED`, or
            :data:`~report.cells.MIXED` where runs are compared that cannot be, or
            :data:`~report.tables.NOT_RUN` where a side was planned and has no run, or
            :data:`NOT_MEASURED` where there are runs that do not say what is compared, as those
            with one number of real samples do not say how many are needed.
        effect: its size, in words.
        ends: what the effect lies between, where it is known by its ends alone.
        interval: its 95 % interval over training seeds, or over turns.
        seeds: number of training seeds on either side, and of how many where more were planned;
            or of turns.
    """

    what: str
    verdict: str
    effect: str
    ends: str
    interval: str
    seeds: str


def of_differences(pairs: Sequence[Pair]) -> list[Finding]:
    """Findings of one family of tests, by Holm; those that were planned count, tested or not."""
    findings = []
    p_values = [math.nan if pair.gap is None else pair.gap.p for pair in pairs]
    family = sum(pair.planned or not math.isnan(p) for pair, p in zip(pairs, p_values, strict=True))
    for pair, p in zip(pairs, holm(p_values, family), strict=True):
        gap = pair.gap
        if gap is None:
            absent = Finding(pair.what, pair.absent, "–", "–", "–", pair.seeds)
            findings += [absent] if pair.planned else []
            continue
        verdict = _verdict(gap, p, pair.least)
        effect = _text(gap.mean, "+") + ("" if math.isnan(p) else f", p = {p:.2g}")
        if pair.least and not math.isnan(p):
            effect += f" of {_text(pair.least)}"
        within = margin(pair.task)
        if verdict == NOT_SHOWN and within is not None and gap.within(within):
            effect += ", equivalent"
        interval = "–" if math.isnan(gap.low) else f"{_text(gap.low)} to {_text(gap.high)}"
        findings.append(Finding(pair.what, verdict, effect, "–", interval, pair.seeds))
    return findings


def _verdict(gap: Difference, p: float, least: float) -> str:
    """That of a difference with an adjusted p-value of its being ``least``."""
    if gap.mixed:
        return MIXED
    if least < 0 and gap.varies_nowhere:  # no test, and no doubt on which side of the margin it is
        return SHOWN if gap.mean > least else REFUTED
    if not p < LEVEL:
        return NOT_SHOWN
    return SHOWN if gap.mean > least else REFUTED


def of_ratio(
    what: str,
    sides: tuple[Sequence[Between], Sequence[Between]],
    ratio: Between,
    least: float,
    effect: str,
    scores: Iterable[Score],
    seeds: str,
) -> Finding:
    """Shown where the ratio is at least ``least`` by its ends and by its interval, or refuted.

    What a ratio lies between says nothing of how it varies from seed to seed, so that its interval
    over seeds must agree. Fewer than :data:`~measures.FEWEST_SEEDS` on either side show nothing.

    Args:
        what: the task.
        sides: what the number of each seed lies between, above and below.
        ratio: what the ratio lies between.
        least: the claim is that it is this or more.
        effect: its size, in words.
        scores: those of either side, which may be mixed.
        seeds: of either side, as a finding has them.
    """
    interval = ratio_interval(*sides)
    verdict = NOT_SHOWN
    if is_mixed(score.run for score in scores):
        verdict = MIXED
    elif min(map(len, sides)) >= FEWEST_SEEDS:
        if ratio.low >= least and interval.low > least:
            verdict = SHOWN
        elif ratio.high < least and interval.high < least:
            verdict = REFUTED
    return Finding(what, verdict, effect, _times_text(ratio), _times_text(interval), seeds)


def _times_text(ratio: Between) -> str:
    above = " and more" if math.isinf(ratio.high) else f" to {ratio.high:.1f}"
    return f"{ratio.low:.1f}{above} times"


def _text(value: float, sign: str = "") -> str:
    return f"{value:{sign}.1f}".replace("-", "−")
