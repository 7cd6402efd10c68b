"""From folders of runs to the paper's tables and figures."""

from __future__ import annotations

from report.bounds import BOUNDS, Bounds, normalise
from report.build import Report, ReportConfig, make_report
from report.efficiency import samples_to_90
from report.paper_systems import PaperSystem, system, systems
from report.results import Results, Score
from report.runs import Acting, Run, RunFolders, read_run, read_runs
from report.sections import Picture, Section
from report.sensitivity import Trial, read_trials, write_trials
from report.significance import published_difference
from report.tables import NOT_RUN, Number, Stat, Table

__all__ = [
    "BOUNDS",
    "NOT_RUN",
    "Acting",
    "Bounds",
    "Number",
    "PaperSystem",
    "Picture",
    "Report",
    "ReportConfig",
    "Results",
    "Run",
    "RunFolders",
    "Score",
    "Section",
    "Stat",
    "Table",
    "Trial",
    "make_report",
    "normalise",
    "published_difference",
    "read_run",
    "read_runs",
    "read_trials",
    "samples_to_90",
    "system",
    "systems",
    "write_trials",
]
