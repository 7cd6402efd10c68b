"""The paper's claims, each with a sentence on whether it is borne out here."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean

from phihp_torchrl.evaluation import PUBLISHED
from report.efficiency import sample_efficiency
from report.paper_systems import (
    DD_CEM,
    PH_CEM,
    PH_TD_MPC_STAR,
    PHIHP,
    TD3,
    TD3_IM_DD,
    TD3_IM_PH,
    TD_MPC,
    TD_MPC_STAR,
    PaperSystem,
)
from report.planner_and_actor import planning_gain, usual_groups
from report.results import TASKS, Results, Score
from report.sections import Section
from report.tables import NOT_RUN

FEWER = 5.0
"""The claim is of 5 to 15 times fewer samples."""

_PAIRS = ((TD3_IM_PH, TD3_IM_DD), (PH_CEM, DD_CEM), (PH_TD_MPC_STAR, TD_MPC_STAR))


@dataclass(frozen=True)
class Finding:
    """What one comparison says on a claim.

    Args:
        what: the task, or the systems and the task.
        borne_out: whether it agrees with the claim.
        figure: its numbers.
    """

    what: str
    borne_out: bool
    figure: str


def claims_section(results: Results) -> Section:
    """A line for each claim."""
    lines = [
        _sentence(
            "PhIHP needs 5 to 15 times fewer real samples than TD-MPC",
            fewer_samples(results),
            _published_samples(results),
        ),
        _sentence("PhIHP earns more than TD3", _higher(results, ((PHIHP, TD3),))),
        _sentence("Planning improves on the policy", planning_improves(results)),
        _sentence(
            "The hybrid model beats the data-driven one at equal samples", _higher(results, _PAIRS)
        ),
        _sentence(
            "PhIHP acts faster than TD-MPC",
            faster(results),
            "the published times are of another machine",
        ),
    ]
    return Section("The paper's claims", "\n".join(f"- {line}" for line in lines))


def fewer_samples(results: Results) -> list[Finding]:
    """TD-MPC's samples to 90 % over PhIHP's, by task."""
    findings = []
    for task in TASKS:
        ours = sample_efficiency(results, PHIHP, task)
        theirs = sample_efficiency(results, TD_MPC, task)
        if ours and theirs:
            ratio = fmean(theirs) / fmean(ours)
            figure = f"{_text(ratio)} times fewer ({fmean(ours):.0f} against {fmean(theirs):.0f})"
            findings.append(Finding(task, ratio >= FEWER, figure))
    return findings


def planning_improves(results: Results) -> list[Finding]:
    """Planner less actor at the usual number of samples, by task; beyond two standard errors."""
    findings = []
    groups = usual_groups(results.runs)
    for task, group in ((task, groups[task]) for task in groups if task in TASKS):
        gain = planning_gain(group)
        figure = f"{_text(gain.mean, '+')} ± {_text(gain.standard_error)}"
        better = gain.mean > 2 * gain.standard_error
        findings.append(Finding(task, better, figure))
    return findings


def faster(results: Results) -> list[Finding]:
    """TD-MPC's time of an action over PhIHP's, by task."""
    findings = []
    for task in TASKS:
        ours, theirs = (_times(results.usual(system, task)) for system in (PHIHP, TD_MPC))
        if ours and theirs:
            ratio = fmean(theirs) / fmean(ours)
            figure = f"{ratio:.1f} times ({fmean(ours):.1f} ms against {fmean(theirs):.1f})"
            findings.append(Finding(task, ratio > 1, figure))
    return findings


def _higher(results: Results, pairs: Iterable[tuple[PaperSystem, PaperSystem]]) -> list[Finding]:
    """Mean returns of pairs; at the same samples where they are ablations of each other."""
    findings = []
    for first, second in pairs:
        for task in TASKS:
            ours, theirs = results.usual(first, task), results.usual(second, task)
            if first is not PHIHP:
                ours, theirs = _at_equal_samples(results, first, second, task)
            if ours and theirs:
                means = [fmean(score.mean for score in scores) for scores in (ours, theirs)]
                figure = f"{_text(means[0])} against {_text(means[1])}"
                what = task if first is PHIHP else f"{first.name} on {task}"
                findings.append(Finding(what, means[0] > means[1], figure))
    return findings


def _at_equal_samples(
    results: Results, first: PaperSystem, second: PaperSystem, task: str
) -> tuple[list[Score], list[Score]]:
    """The scores of both at the largest number of samples that both were run with."""
    both = [results.scores(system, task) for system in (first, second)]
    common = set.intersection(*({score.run.samples for score in scores} for scores in both))
    ours, theirs = ([s for s in scores if s.run.samples == max(common, default=0)]
                    for scores in both)  # fmt: skip
    return ours, theirs


def _times(scores: Sequence[Score]) -> list[float]:
    return [score.milliseconds for score in scores if score.milliseconds is not None]


def _published_samples(results: Results) -> str:
    """PhIHP's samples here against the published ones of TD-MPC."""
    parts = []
    for task in TASKS:
        ours = sample_efficiency(results, PHIHP, task)
        published = PUBLISHED.get(task, {}).get(TD_MPC.name)
        if ours and published is not None and published.samples is not None:
            parts.append(f"{task} {1000 * published.samples / fmean(ours):.1f}")
    return f"against TD-MPC as published, times fewer: {', '.join(parts)}" if parts else ""


def _sentence(claim: str, findings: Sequence[Finding], unless: str = "") -> str:
    """The claim, the verdict and the figures; ``unless`` says more where nothing was run."""
    if not findings:
        return f"**{claim}**: {NOT_RUN}{f' ({unless})' if unless else ''}."
    count = sum(finding.borne_out for finding in findings)
    if count == len(findings):
        verdict = f"borne out here, in all {count} comparisons" if count > 1 else "borne out here"
    elif count:
        verdict = f"borne out here in {count} of {len(findings)} comparisons"
    else:
        verdict = "not borne out here"
    figures = "; ".join(f"{f.what} {f.figure}{'' if f.borne_out else ' (not)'}" for f in findings)
    return f"**{claim}**: {verdict}: {figures}."


def _text(value: float, sign: str = "") -> str:
    return f"{value:{sign}.1f}".replace("-", "−")
