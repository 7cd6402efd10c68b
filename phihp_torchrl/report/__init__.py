"""From folders of runs to the paper's tables and figures."""

from __future__ import annotations

from phihp_torchrl.report.bounds import BOUNDS, Bounds, normalise
from phihp_torchrl.report.efficiency import samples_to_90
from phihp_torchrl.report.make import Report, ReportConfig, make_report
from phihp_torchrl.report.parts import NOT_RUN, Number, Picture, Section, Stat, Table
from phihp_torchrl.report.results import Results, Score
from phihp_torchrl.report.runs import Acting, Run, RunFolders, read_run, read_runs
from phihp_torchrl.report.sensitivity import Trial, read_trials, write_trials
from phihp_torchrl.report.significance import Welch, welch
from phihp_torchrl.report.systems import SYSTEMS, System

__all__ = [
    "BOUNDS",
    "NOT_RUN",
    "SYSTEMS",
    "Acting",
    "Bounds",
    "Number",
    "Picture",
    "Report",
    "ReportConfig",
    "Results",
    "Run",
    "RunFolders",
    "Score",
    "Section",
    "Stat",
    "System",
    "Table",
    "Trial",
    "Welch",
    "make_report",
    "normalise",
    "read_run",
    "read_runs",
    "read_trials",
    "samples_to_90",
    "welch",
    "write_trials",
]
