"""Sample efficiency: how many real samples a system needs for 90 % of its own best return."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from report.paper_systems import PaperSystem
from report.results import Results, Score

SHARE = 0.9
"""The share of its own best return that a system must reach."""


def learning_points(score: Score) -> list[tuple[int, float]]:
    """Real samples and mean return at the evaluations of a run, with rising samples.

    A run that learns its policy in a model takes no real step meanwhile: of evaluations at the
    same number of samples, the last counts.

    Args:
        score: the run, and how it acts.
    """
    only_way = len(score.run.acting) == 1
    points = {p.real_steps: p.return_mean for p in score.run.curve
              if only_way or p.acting == score.acting}  # fmt: skip
    # The final evaluation is of the agent that is kept, and over more episodes.
    points[max(points, default=score.run.samples)] = score.mean
    return sorted(points.items())


def points_by_seed(scores: Sequence[Score]) -> dict[int, list[tuple[int, float]]]:
    """The evaluations of each seed, out of its runs with few samples and with many."""
    points: dict[int, dict[int, float]] = defaultdict(dict)
    for score in sorted(scores, key=lambda score: score.run.samples):
        points[score.run.seed].update(learning_points(score))
    return {seed: sorted(found.items()) for seed, found in sorted(points.items())}


def samples_to_90(points: Sequence[tuple[int, float]]) -> int:
    """The fewest real samples after which a return within a tenth of the best was reached.

    For the best return ``b`` the threshold is ``b − 0.1 |b|``, which is 90 % of a positive return
    and 110 % of a negative one.

    Args:
        points: real samples and returns of one seed.

    Examples:
        >>> samples_to_90([(500, -900.0), (1000, -380.0), (2000, -360.0)])
        1000
    """
    best = max(value for _, value in points)
    threshold = best - (1 - SHARE) * abs(best)
    return min(samples for samples, value in points if value >= threshold)


def sample_efficiency(results: Results, system: PaperSystem, task: str) -> tuple[float, ...]:
    """The samples to 90 % of each seed; empty if the system was not run."""
    by_seed = points_by_seed(results.scores(system, task))
    return tuple(float(samples_to_90(points)) for points in by_seed.values())
