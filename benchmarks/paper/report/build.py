"""A report from folders of runs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from phihp_torchrl.config import ConfigError, check_count
from phihp_torchrl.evaluation import PROOF_SEED
from phihp_torchrl.trainers import import_plugins
from report.ablation import ablation
from report.action_times import read_turns
from report.at_a_glance import at_a_glance
from report.claims import claims_section
from report.curves import imagined_curves, learning_curves
from report.generalization import generalization
from report.main_table import main_table
from report.over_runs import aggregate_section
from report.overview import origins, overview
from report.planned import read_planned
from report.planned_section import planned_section
from report.planner_and_actor import acting_section
from report.results import Results
from report.runs import Run, read_runs
from report.sections import Section
from report.sensitivity import read_trials, sensitivity
from report.significance import significance
from report.soundness import soundness
from report.time_to_return import time_to_return
from report.write import write_report

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReportConfig:
    """Where a report comes from and goes; ``config/report.yaml`` mirrors it.

    Args:
        runs: directory with a folder for each run.
        sensitivity: directory of ``sensitivity.py``'s data.
        latency: directory of ``latency.py``'s data.
        benchmarks: what ``make bench`` wrote.
        out: directory of the report.
        label: the settings whose runs it is on.
        any_version: whether to take runs of other versions of this package.
        reps: resamples of the bootstrap.
        overview: page with PhIHP's tables for every label; ``None`` for none.
        plugins: Python files or modules to import, which register tasks and methods.
    """

    runs: str = "results/runs"
    sensitivity: str = "results/sensitivity"
    latency: str = "results/latency"
    benchmarks: str = "results/benchmarks/benchmarks.json"
    out: str = "results/report"
    label: str = "default"
    any_version: bool = False
    reps: int = 2000
    overview: str | None = "results/README.md"
    plugins: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_count(self, "reps")


@dataclass(frozen=True)
class Report:
    """A report that was made.

    Args:
        sections: its parts.
        problems: a sentence for each folder that was left out, and each part that could not be
            made.
    """

    sections: tuple[Section, ...]
    problems: tuple[str, ...]


def _of_the_proof(runs: Sequence[Run], problems: list[str]) -> list[Run]:
    """Those of the last proof, if there are any: others have played other episodes.

    Args:
        runs: all finished runs.
        problems: where those that are left out are named.
    """
    proof = [run for run in runs if run.first_seed == PROOF_SEED]
    others = [run.folder.name for run in runs if run.first_seed != PROOF_SEED]
    if not (proof and others):
        return [*runs]
    problems.append(f"Not of the last proof, and left out: {', '.join(others)}.")
    return proof


def make_report(config: ReportConfig) -> Report:
    """Make all of a report that can be made, and write it.

    Args:
        config: from where and to where.

    Raises:
        ConfigError: where folders of runs are there, and none of them can be read; nothing is
            written then, so that no report is replaced by an empty one.
    """
    import_plugins(config.plugins)
    folders = read_runs(Path(config.runs), any_version=config.any_version)
    trials, unread = read_trials(Path(config.sensitivity))
    turns, untimed = read_turns(Path(config.latency))
    problems = [*folders.problems, *unread, *untimed]
    if not folders.runs and any(path.is_dir() for path in Path(config.runs).glob("*")):
        raise ConfigError(
            "runs",
            f"expected finished runs in {config.runs}, could read none of "
            f"{len(folders.problems)}; the first says: {folders.problems[0]}",
        )
    runs = _of_the_proof(folders.runs, problems)
    chosen = [run for run in runs if run.label == config.label]
    every = read_planned(Path(config.runs))
    planned = every.of(config.label)
    results = Results(chosen, planned)
    makers: dict[str, Callable[[], Section]] = {
        "The paper's claims": lambda: claims_section(results, turns),
        "At a glance": lambda: at_a_glance(results, turns),
        "Planned and done": lambda: planned_section(every, runs),
        "Soundness": lambda: soundness(chosen),
        "Main table": lambda: main_table(results),
        "Learning curves": lambda: learning_curves(results),
        "Performance over runs": lambda: aggregate_section(results, config.reps),
        "PhIHP against each baseline": lambda: significance(results),
        "Ablation": lambda: ablation(results),
        "Generalization": lambda: generalization(results),
        "TD3 in imagination": lambda: imagined_curves(results),
        "Sensitivity": lambda: sensitivity(trials),
        "PhIHP, planner and actor": lambda: acting_section(chosen, planned),
        "From nothing to the published return": lambda: time_to_return(
            chosen, Path(config.benchmarks)
        ),
    }
    sections = [_make(title, make, problems) for title, make in makers.items()]
    if problems:
        sections.append(_left_out(problems))
    introduction = (
        f"Made by `python benchmarks/paper/make_report.py` from `{config.runs}`, label "
        f"`{config.label}`. Do not edit. `docs/evaluation.md` defines each metric. "
        + (origins(chosen) if chosen else "There are no runs with that label.")
    )
    write_report(Path(config.out), "Report", introduction, sections)
    if config.overview is not None:
        Path(config.overview).parent.mkdir(parents=True, exist_ok=True)
        Path(config.overview).write_text(overview(runs, every))
    return Report(tuple(sections), tuple(problems))


def _make(title: str, make: Callable[[], Section], problems: list[str]) -> Section:
    """A section, or a word on why it could not be made."""
    try:
        return make()
    except Exception as error:  # one part that fails, such as one of an extra, costs no other
        _log.warning("%s: not made.", title, exc_info=not isinstance(error, ImportError))
        problems.append(f"{title}: not made: {type(error).__name__}: {error}")
        return Section(title, f"Not made: {error}")


def _left_out(problems: Sequence[str]) -> Section:
    return Section("Left out", "\n".join(f"- {problem}" for problem in problems))
