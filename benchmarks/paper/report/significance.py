"""PhIHP against each baseline: differences with intervals, tested as one family."""

from __future__ import annotations

import math

from scipy import stats

from measures import FEWEST_SEEDS, Difference, difference, holm
from phihp_torchrl.evaluation import PUBLISHED
from report.bounds import margin
from report.paper_systems import PHIHP, PaperSystem, systems
from report.results import Results
from report.sections import Section
from report.tables import NOT_RUN, Number, Table, TableCell

LEVEL = 0.05
"""Below this p-value, adjusted by Holm, a difference counts as significant."""

_PUBLISHED_RUNS = 10


def verdict(found: Difference, p: float, within: float | None) -> str:
    """What a comparison says: higher, lower, equivalent, or nothing.

    Args:
        found: the difference.
        p: its p-value, adjusted for the family that it is tested in.
        within: the margin of equivalence, where there is one.
    """
    if p < LEVEL:
        return "higher" if found.mean > 0 else "lower"
    if found.mean == 0.0 and math.isnan(found.low):
        return "the same in every run"
    if within is not None and found.within(within):
        return "equivalent"
    return "nothing shown" if min(found.seeds) >= FEWEST_SEEDS else "too few seeds"


def published_difference(task: str, baseline: str) -> Difference | None:
    """The difference of the published means, by their standard deviations over 10 runs."""
    rows = PUBLISHED.get(task, {})
    if not {"PhIHP", baseline} <= rows.keys():
        return None
    ours, theirs = rows["PhIHP"], rows[baseline]
    moments = [(row.return_mean, row.return_std, _PUBLISHED_RUNS) for row in (ours, theirs)]
    test = stats.ttest_ind_from_stats(*moments[0], *moments[1], equal_var=False)
    variances = [std**2 / n for _, std, n in moments]
    freedom = sum(variances) ** 2 / sum(v**2 / (_PUBLISHED_RUNS - 1) for v in variances)
    mean = ours.return_mean - theirs.return_mean
    half = stats.t.ppf(0.975, freedom) * math.sqrt(sum(variances))
    return Difference(mean, mean - half, mean + half, float(test.pvalue), (_PUBLISHED_RUNS,) * 2)


def significance(results: Results) -> Section:
    """A row for each task and baseline; all rows are one family of tests."""
    pairs = [(task, baseline) for task in results.tasks for baseline in systems("baseline")]

    def means(system: PaperSystem, task: str) -> list[float]:
        return [score.mean for score in results.usual(system, task)]

    own = [difference(means(PHIHP, task), means(baseline, task)) for task, baseline in pairs]
    printed = [published_difference(task, baseline.name) for task, baseline in pairs]
    rows: list[list[TableCell]] = []
    columns = zip(pairs, own, _adjusted(own), printed, _adjusted(printed), strict=True)
    for (task, baseline), found, p, theirs, their_p in columns:
        rows.append(
            [
                f"{task}, {baseline.name}",
                *_cells(found, p, margin(task), NOT_RUN),
                *_cells(theirs, their_p, None, "–"),
            ]
        )
    header = ["task, PhIHP less", "difference", "95 % from", "to", "p", "seeds", "PhIHP is"]
    header += [f"published: {name}" for name in header[1:]]
    return Section(
        "PhIHP against each baseline",
        "Differences of mean returns over training seeds, with Welch's intervals. p-values are "
        "adjusted by Holm over all rows, and below "
        f"{FEWEST_SEEDS} seeds or without any spread there is none. *Equivalent* are two whose "
        "whole interval lies within 1 % of the range of returns. Under *published*, the same from "
        f"the published means and standard deviations of {_PUBLISHED_RUNS} runs each, a family of "
        "its own; the paper's own table has larger t, as more values than ten would give.",
        {"Differences": Table("differences", header, rows)},
    )


def _adjusted(found: list[Difference | None]) -> list[float]:
    return holm([math.nan if one is None else one.p for one in found])


def _cells(found: Difference | None, p: float, within: float | None, short: str) -> list[TableCell]:
    if found is None:
        return [short] * 6
    ends: list[TableCell] = [
        "–" if math.isnan(v) else Number(v, 1, fixed=True) for v in (found.low, found.high)
    ]
    shown: TableCell = "–" if math.isnan(p) else Number(p, 2)
    seeds = f"{found.seeds[0]}, {found.seeds[1]}"
    words = verdict(found, p, within)
    return [Number(found.mean, 1, fixed=True), *ends, shown, seeds, words]
