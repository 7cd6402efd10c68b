"""PhIHP against each baseline: differences with intervals, to explore; claims have verdicts."""

from __future__ import annotations

import math
from collections.abc import Sequence

from scipy import stats

from measures import FEWEST_SEEDS, Difference, holm
from phihp_torchrl.evaluation import PUBLISHED
from report.comparison import compared, numbers
from report.paper_systems import PHIHP, systems
from report.results import Results
from report.sections import Section
from report.tables import NOT_RUN, Table, TableCell

_PUBLISHED_RUNS = 10


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
    """A row for each task and baseline, without a verdict: those are of the claims' families."""
    pairs = [(task, baseline) for task in results.tasks for baseline in systems("baseline")]
    own = [
        compared(results.usual(PHIHP, task), results.usual(baseline, task))
        for task, baseline in pairs
    ]
    asked = [results.planned.both(PHIHP, baseline, task) for task, baseline in pairs]
    printed = [published_difference(task, baseline.name) for task, baseline in pairs]
    rows: list[list[TableCell]] = [
        [f"{task}, {baseline.name}", *_cells(found, p, NOT_RUN), *_cells(theirs, their_p, "–")]
        for (task, baseline), found, p, theirs, their_p in zip(
            pairs, own, _adjusted(own, asked), printed, _adjusted(printed), strict=True
        )
    ]
    header = ["task, PhIHP less", "difference", "95 % from", "to", "p", "seeds"]
    header += [f"published: {name}" for name in header[1:]]
    return Section(
        "PhIHP against each baseline",
        "Exploratory: what is judged is under *The paper's claims*. Differences of mean returns "
        "over training seeds, with Welch's intervals. p-values are adjusted by Holm over all rows "
        f"here that are tested or were planned, and below {FEWEST_SEEDS} seeds or without any "
        "spread there is none, nor where cells are *mixed*, of several configurations or of "
        "different episodes. Under *published*, the same from "
        f"the published means and standard deviations of {_PUBLISHED_RUNS} runs each, a family of "
        "its own; the paper's own table has larger t, as more values than ten would give.",
        {"Differences": Table("differences", header, rows)},
    )


def _adjusted(found: list[Difference | None], planned: Sequence[bool] = ()) -> list[float]:
    """Adjusted for all that are tested, and for those planned that could not be."""
    p_values = [math.nan if one is None else one.p for one in found]
    tested = [not math.isnan(p) for p in p_values]
    return holm(p_values, sum(map(any, zip(tested, planned or tested, strict=True))))


def _cells(found: Difference | None, p: float, short: str) -> list[TableCell]:
    if found is None:
        return [short] * 5
    return [*numbers(found, p, 1), f"{found.seeds[0]}, {found.seeds[1]}"]
