"""Sample efficiency: how many real samples a system needs for 90 % of its own best return."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from measures import Between, mean_between
from report.paper_systems import PaperSystem
from report.results import Results, Score
from report.tables import Ends

SHARE = 0.9
"""The share of its own best return that a system must reach."""

ONE_NUMBER = "one number"
"""What stands where a system was run with one number of real samples, which tells nothing."""


def learning_points(score: Score) -> list[tuple[int, float]]:
    """Real samples and mean return at the evaluations of a run, with rising samples.

    A run that learns its policy in a model takes no real step meanwhile: of evaluations at the
    same number of samples, the last counts. An agent that plans, of which only the actor was
    evaluated while it took real steps, has the actor's curve.

    Args:
        score: the run, and how it acts.
    """
    run, way = score.run, score.acting
    learning = {p.acting for p in run.curve if p.phase != "evaluate"}
    if way not in learning and len({p.real_steps for p in run.curve}) > 1 and "actor" in run.acting:
        way = "actor"  # which alone was evaluated while it took real steps
    only_way = len(run.acting) == 1
    points = {p.real_steps: p.return_mean for p in run.curve if only_way or p.acting == way}
    # The final evaluation is of the agent that is kept, and over more episodes.
    points[max(points, default=run.samples)] = run.acting[way].mean
    return sorted(points.items())


def points_by_seed(scores: Sequence[Score]) -> dict[int, list[tuple[int, float]]]:
    """The evaluations of each seed, out of its runs with few samples and with many."""
    points: dict[int, dict[int, float]] = defaultdict(dict)
    for score in sorted(scores, key=lambda score: score.run.samples):
        points[score.run.seed].update(learning_points(score))
    return {seed: sorted(found.items()) for seed, found in sorted(points.items())}


def samples_to_90(points: Sequence[tuple[int, float]]) -> Between:
    """The real samples after which a return within a tenth of the best was reached.

    For the best return ``b`` the threshold is ``b − 0.1 |b|``, which is 90 % of a positive return
    and 110 % of a negative one. It was passed somewhere between the evaluation that first reached
    it and the one before, or before the first one.

    Args:
        points: real samples and returns of one seed.

    Examples:
        >>> str(samples_to_90([(500, -900.0), (1000, -380.0), (2000, -360.0)]))
        '500–1000'
        >>> str(samples_to_90([(500, -370.0), (1000, -360.0)]))
        '≤ 500'
    """
    best = max(value for _, value in points)
    threshold = best - (1 - SHARE) * abs(best)
    first = min(samples for samples, value in points if value >= threshold)
    before = max((samples for samples, _ in points if samples < first), default=0)
    return Between(before, first)


def efficiency_of_seeds(results: Results, system: PaperSystem, task: str) -> list[Between]:
    """What the samples of each seed lie between, by seed (:meth:`Results.whole`).

    Of a seed with a return at one number of samples alone nothing is known: that return is its best
    one, whatever it is. A system that needs none has 0.
    """
    points = points_by_seed(results.whole(system, task)).values()
    return [samples_to_90(of_seed) for of_seed in points if len(of_seed) > 1 or not of_seed[0][0]]


def sample_efficiency(results: Results, system: PaperSystem, task: str) -> Between | None:
    """What a system's mean over seeds lies between; ``None`` if nothing is known of it."""
    found = efficiency_of_seeds(results, system, task)
    return mean_between(found) if found else None


def mean_samples(results: Results, system: PaperSystem, tasks: Sequence[str]) -> Between | None:
    """What its mean over tasks lies between; ``None`` if nothing is known of one of them."""
    samples = [sample_efficiency(results, system, task) for task in tasks]
    known = [between for between in samples if between is not None]
    return mean_between(known) if len(known) == len(tasks) else None


def samples_cell(results: Results, system: PaperSystem, task: str) -> Ends | str:
    """The same for a table, with the number of seeds."""
    found = efficiency_of_seeds(results, system, task)
    if not found and results.has_run(system, task):
        return ONE_NUMBER
    return Ends(mean_between(found) if found else None, len(found))
