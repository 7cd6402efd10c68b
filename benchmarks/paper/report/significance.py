"""Welch's t-tests of PhIHP against each baseline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from phihp_torchrl.evaluation import PUBLISHED
from report.paper_systems import PHIHP, systems
from report.results import Results
from report.sections import Section
from report.tables import Number, Table, TableCell

LEVEL = 0.05
"""Below this p-value a difference counts as significant."""

_PUBLISHED_RUNS = 10


class Welch(NamedTuple):
    """A t-test for unequal variances.

    Attributes:
        t: positive where the first sample is higher.
        p: two-sided p-value.
    """

    t: float
    p: float

    def __str__(self) -> str:
        if not self.p < LEVEL:
            return "no difference"
        return "higher" if self.t > 0 else "lower"


def welch(a: Sequence[float], b: Sequence[float]) -> Welch | None:
    """Test whether the means of ``a`` and ``b`` differ; ``None`` for fewer than two of either.

    Raises:
        ImportError: without the extra ``report``.
    """
    stats = _stats()
    if min(len(a), len(b)) < 2:
        return None
    if len({*a}) == len({*b}) == 1:
        # No variance at all: t is infinite, or 0 / 0 where the means are equal.
        same = a[0] == b[0]
        return Welch(0.0 if same else (1 if a[0] > b[0] else -1) * float("inf"), float(same))
    found = stats.ttest_ind(a, b, equal_var=False)
    return Welch(float(found.statistic), float(found.pvalue))


def welch_published(task: str, baseline: str) -> Welch | None:
    """The test on the published means and standard deviations of 10 runs."""
    rows = PUBLISHED.get(task, {})
    if not {"PhIHP", baseline} <= rows.keys():
        return None
    ours, theirs = rows["PhIHP"], rows[baseline]
    found = _stats().ttest_ind_from_stats(
        ours.return_mean,
        ours.return_std,
        _PUBLISHED_RUNS,
        theirs.return_mean,
        theirs.return_std,
        _PUBLISHED_RUNS,
        equal_var=False,
    )
    return Welch(float(found.statistic), float(found.pvalue))


def significance(results: Results) -> Section:
    """A row for each task and baseline."""
    rows: list[list[TableCell]] = []
    for task in results.tasks:
        ours = [score.mean for score in results.usual(PHIHP, task)]
        for baseline in systems("baseline"):
            theirs = [score.mean for score in results.usual(baseline, task)]
            test, published = welch(ours, theirs), welch_published(task, baseline.name)
            short = "not run" if not (ours and theirs) else "too few seeds"
            rows.append([
                f"{task}, {baseline.name}",
                *([Number(test.t), Number(test.p, 2), str(test)] if test else [short] * 3),
                *([Number(published.t), Number(published.p, 2), str(published)]
                  if published else ["–"] * 3),
            ])  # fmt: skip
    header = ["task, PhIHP against", "t", "p", "PhIHP is", "published: t", "p", "PhIHP is"]
    return Section(
        "Welch's t-tests",
        f"On the mean returns of seeds; significant below p = {LEVEL}. Under *published*, the same "
        f"test on the published means and standard deviations of {_PUBLISHED_RUNS} runs each; the "
        "paper's own table has larger t, as more values than ten would give.",
        {"PhIHP against each baseline": Table("welch", header, rows)},
    )


def _stats():  # type: ignore[no-untyped-def]  # a module
    try:
        from scipy import stats
    except ImportError as error:
        raise ImportError(
            f"scipy: expected it for t-tests, it cannot be imported ({error}); "
            "`pip install 'phihp_torchrl[report]'` brings it."
        ) from error
    return stats
