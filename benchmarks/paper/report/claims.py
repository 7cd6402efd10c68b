"""The paper's claims: what is compared for each, and the sentence that a careful reader writes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from itertools import product
from typing import NamedTuple

from measures import mean_between, ratio_between
from phihp_torchrl.evaluation import PUBLISHED
from report.action_times import Turns, faster
from report.bounds import EQUIVALENT, margin
from report.cells import MIXED
from report.comparison import compared
from report.efficiency import efficiency_of_seeds, sample_efficiency
from report.paper_systems import (
    DD_CEM,
    DD_PHIHP,
    PH_CEM,
    PH_TD_MPC_STAR,
    PHIHP,
    TD3,
    TD3_IM_DD,
    TD3_IM_PH,
    TD_MPC,
    TD_MPC_STAR,
    PaperSystem,
    systems,
)
from report.planner_and_actor import planning_gain, usual_groups
from report.results import TASKS, Results, Score, well_filled
from report.sections import Section
from report.tables import NOT_RUN, Table, TableCell
from report.verdicts import (
    NOT_MEASURED,
    NOT_SHOWN,
    REFUTED,
    SHOWN,
    Finding,
    Pair,
    of_differences,
    of_ratio,
)

FEWER = 5.0
"""The claim is of 5 to 15 times fewer samples."""

_MOST_NAMES = 6
"""A sentence names no more comparisons of one verdict; the table has all."""

REDUCED = (
    "TD-MPC is of a reduced width here: its encoder has a half, its other networks and its "
    "candidates a quarter of the published sizes."
)

_PAIRS = (
    (PHIHP, DD_PHIHP),
    (TD3_IM_PH, TD3_IM_DD),
    (PH_CEM, DD_CEM),
    (PH_TD_MPC_STAR, TD_MPC_STAR),
)


class Claim(NamedTuple):
    """A claim of the paper, or of ours, as it is judged.

    Attributes:
        words: what is claimed.
        findings: of its comparisons.
        sides: the systems that they are of.
    """

    words: str
    findings: Sequence[Finding]
    sides: Sequence[Sequence[PaperSystem]] = ()


def claims(results: Results, turns: Turns) -> list[Claim]:
    """All claims, in their order."""
    baselines = [(PHIHP, baseline) for baseline in systems("baseline")]
    return [
        Claim(
            f"PhIHP needs at least {FEWER:.0f} times fewer real samples than TD-MPC",
            fewer_samples(results),
            [(PHIHP, TD_MPC)],
        ),
        Claim("PhIHP earns more than TD3", earns_more(results, PHIHP, TD3), [(PHIHP, TD3)]),
        Claim("Planning improves on the policy", planning_improves(results), [(PHIHP,)]),
        Claim(
            "The hybrid model beats the data-driven one at equal samples",
            hybrid_earns_more(results),
            _PAIRS,
        ),
        Claim("PhIHP acts faster than TD-MPC", faster(turns, results.preset(PHIHP))),
        Claim(
            f"PhIHP earns as much as each baseline, to {EQUIVALENT:.0%} of a task's range",
            not_worse(results),
            baselines,
        ),
    ]


def claims_section(results: Results, turns: Turns | None = None) -> Section:
    """A sentence for each claim, and a row for each comparison.

    Args:
        results: the scores, and what was planned.
        turns: times of an action (:func:`~report.action_times.read_turns`).
    """
    judged = claims(results, turns or {})
    lines = [
        f"- **{claim.words}**: {sentence(claim.findings, done=_any_done(results, claim.sides))}"
        for claim in judged
    ]
    if published := _published_samples(results):
        lines.append(f"- {published}")
    if is_reduced(results):
        lines.append(f"- {REDUCED}")
    rows: list[list[TableCell]] = [
        [f"{i}, {f.what}", f.verdict, f.effect, f.ends, f.interval, f.seeds]
        for i, claim in enumerate(judged, 1)
        for f in claim.findings
    ]
    header = ["claim, comparison", "verdict", "effect", "lies between", "95 % interval"]
    header += ["seeds or turns"]
    return Section(
        "The paper's claims", "\n".join(lines), {"Comparisons": Table("claims", header, rows)}
    )


def is_reduced(results: Results) -> bool:
    """Whether a run of TD-MPC has the affordable widths of the default preset."""
    return any(run.method == "td-mpc" and run.preset == "default" for run in results.runs)


def sentence(findings: Sequence[Finding], *, done: bool = False) -> str:
    """What a careful reader would say of a claim.

    Args:
        findings: those of its comparisons.
        done: whether there are runs of both sides, be they such that nothing can be compared.
    """
    if not findings:
        return "nothing to compare." if done else f"{NOT_RUN}."
    counts = Counter(finding.verdict for finding in findings)
    total = len(findings)
    parts = [
        f"{verdict} in {counts[verdict]}"
        for verdict in (SHOWN, NOT_SHOWN, REFUTED, MIXED, NOT_RUN, NOT_MEASURED)
        if counts[verdict]
    ]
    named = "; ".join(
        f"{verdict}: {', '.join(f.what for f in findings if f.verdict == verdict)}"
        for verdict in (SHOWN, REFUTED, MIXED, NOT_RUN, NOT_MEASURED)
        if 0 < counts[verdict] <= _MOST_NAMES
    )
    return f"{', '.join(parts)} of {total} comparisons{f' ({named})' if named else ''}."


def _any_done(results: Results, pairs: Iterable[Sequence[PaperSystem]]) -> bool:
    """Whether all sides of any of these comparisons have a run on a task."""
    return any(
        all(results.has_run(one, task) for one in sides) for sides in pairs for task in TASKS
    )


def fewer_samples(results: Results) -> list[Finding]:
    """TD-MPC's samples to 90 % over PhIHP's, by task, as far as their ends tell."""
    findings = []
    for task in TASKS:
        both = PHIHP, TD_MPC
        ours, theirs = (efficiency_of_seeds(results, one, task) for one in both)
        scores = [results.whole(one, task) for one in both]
        seeds = ", ".join(
            _of_planned(
                len({score.run.seed for score in of_one}),
                results.planned.whole_seeds(one, task, _samples(of_one)),
            )
            for one, of_one in zip(both, scores, strict=True)
        )
        if ours and theirs:
            between = mean_between(theirs), mean_between(ours)
            findings.append(
                of_ratio(
                    task,
                    (theirs, ours),
                    ratio_between(*between),
                    FEWER,
                    f"{between[1]} against {between[0]} samples",
                    [score for side in scores for score in side],
                    seeds,
                )
            )
        elif results.planned.both(*both, task):
            verdict = NOT_MEASURED if all(scores) else NOT_RUN
            findings.append(Finding(task, verdict, "–", "–", "–", seeds))
    return findings


def planning_improves(results: Results) -> list[Finding]:
    """Agent less actor at the usual number of samples, by task."""
    groups, pairs = usual_groups(results.runs), []
    for task in TASKS:
        group = groups.get(task, [])
        planned = results.planned.seeds(PHIHP, task, {run.samples for run in group})
        seeds = ", ".join([_of_planned(len(group), planned)] * 2)
        gap = planning_gain(group) if group else None
        absent = NOT_MEASURED if results.has_run(PHIHP, task) else NOT_RUN
        pairs.append(Pair(task, task, gap, seeds, planned > 0, absent))
    return of_differences(pairs)


def earns_more(results: Results, first: PaperSystem, second: PaperSystem) -> list[Finding]:
    """The difference of mean returns at the usual numbers of samples, by task."""
    return of_differences([_usual(results, first, second, task, task) for task in TASKS])


def hybrid_earns_more(results: Results) -> list[Finding]:
    """The difference of mean returns of each pair of ablations, at each number of samples."""
    found = []
    for (first, second), task in product(_PAIRS, TASKS):
        asked = results.planned.at_equal_samples(first, second, task)
        run = _equal_samples(results, first, second, task)
        for number in sorted(run | {number for number in asked if number is not None}):
            sides = results.at(number, first, task), results.at(number, second, task)
            seeds = _seeds(results, (first, second), task, sides, {number}, {number})
            what = f"{first.name} on {task}, {number} samples"
            planned = not asked.isdisjoint({None, number})
            found.append(Pair(what, task, compared(*sides), seeds, planned))
        if None in asked and not run:  # a number that is known when both are run
            each = results.scores(first, task), results.scores(second, task)
            seeds = _seeds(results, (first, second), task, each, set(), set())
            found.append(Pair(f"{first.name} on {task}", task, None, seeds, True))
    return of_differences(found)


def not_worse(results: Results) -> list[Finding]:
    """Whether PhIHP's mean return is below no baseline's by the margin, by task.

    The difference plus the margin is tested, so that *shown* needs more than a small difference.
    """
    return of_differences(
        [
            _usual(results, PHIHP, baseline, task, f"{baseline.name} on {task}", -within)
            for baseline, task in product(systems("baseline"), TASKS)
            if (within := margin(task)) is not None
        ]
    )


def _usual(
    results: Results,
    first: PaperSystem,
    second: PaperSystem,
    task: str,
    what: str,
    least: float = 0.0,
) -> Pair:
    """Two systems at their usual numbers of samples, to be tested for a difference above least."""
    sides = results.usual(first, task), results.usual(second, task)
    seeds = _seeds(results, (first, second), task, sides, *map(_samples, sides))
    planned = results.planned.both(first, second, task)
    return Pair(what, task, compared(*sides, least=least), seeds, planned, least=least)


def _seeds(
    results: Results,
    both: tuple[PaperSystem, PaperSystem],
    task: str,
    values: Sequence[Collection[object]],
    *samples: Collection[int],
) -> str:
    """The seeds of either side, such as ``7 of 10, 10``.

    Args:
        results: with the plan.
        both: the two sides.
        task: name of the task.
        values: one for each seed, by side.
        samples: the numbers of real samples that are compared, by side.
    """
    planned = (
        results.planned.seeds(system, task, numbers)
        for system, numbers in zip(both, samples, strict=True)
    )
    return ", ".join(_of_planned(len(side), n) for side, n in zip(values, planned, strict=True))


def _of_planned(found: int, planned: int) -> str:
    return f"{found} of {planned}" if planned > found else str(found)


def _samples(scores: Iterable[Score]) -> set[int]:
    return {score.run.samples for score in scores}


def _equal_samples(
    results: Results, first: PaperSystem, second: PaperSystem, task: str
) -> set[int]:
    """The numbers of real samples that two systems have in common, with enough seeds if any has."""
    both = (results.scores(system, task) for system in (first, second))
    return well_filled(*([score.run.samples for score in scores] for scores in both))


def _published_samples(results: Results) -> str:
    """PhIHP's samples here against the published ones of TD-MPC, which were met in other runs."""
    parts = []
    for task in TASKS:
        ours = sample_efficiency(results, PHIHP, task)
        published = PUBLISHED.get(task, {}).get(TD_MPC.name)
        if ours is not None and published is not None and published.samples is not None:
            parts.append(f"{task} {ours} against {1000 * published.samples:.0f}")
    return f"Samples to 90 %, PhIHP's against TD-MPC's as published: {', '.join(parts)}." if parts \
        else ""  # fmt: skip
