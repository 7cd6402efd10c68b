"""Folders of runs as a grid keeps them, and reports on them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

from report import Report, ReportConfig, Results, make_report, read_runs

VERSION = version("phihp_torchrl")


def make_run(
    runs: Path,
    method: str = "phihp",
    task: str = "pendulum",
    seed: int = 0,
    samples: int = 1000,
    label: str = "default",
    acting: dict[str, list[float]] | None = None,
    curve: tuple[tuple[int, float], ...] = (),
    kind: str | None = "hybrid",
    error: float | None = None,
    ms: float = 5.0,
    world: str | None = None,
) -> Path:
    """A finished run's folder, as the benchmark keeps it."""
    acting = acting or {"planner": [-180.0, -190.0], "actor": [-181.0, -192.0]}
    name = f"{task}-{method}-{label}-n{samples}-seed{seed}"
    folder = runs / name
    folder.mkdir(parents=True)
    model = f"model: {{real_steps: {samples}, kind: {kind}}}\n" if kind else "model: null\n"
    model += f"world: {{kind: {world}}}\n" if world else ""  # older runs do not say it
    (folder / "config.yaml").write_text(f"task: {task}\nmethod: {method}\nseed: {seed}\n{model}")
    session = {
        "commit": "0123456789abcdef",
        "dirty": False,
        "versions": {"phihp_torchrl": VERSION},
        "machine": {"cpus": 2, "memory_gib": 8.0, "gpus": 0},
    }
    metadata = {
        "sessions": [session],
        "seconds": {"model": 10.0, "policy": 20.0, "evaluate": 1.0},
        "real_steps": samples,
    }
    (folder / "metadata.json").write_text(json.dumps(metadata))
    cell = {"method": method, "task": task, "seed": seed, "samples": samples, "label": label}
    (folder / "cell.json").write_text(json.dumps(cell))
    lines = ["phase,unit,real_steps,seconds,policy/updates,policy/real_return"]
    lines += [f"policy,{i},{x},{i},{10 * i},{y}" for i, (x, y) in enumerate(curve)]
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    evaluation = {
        way: {
            "returns": returns,
            "latency_ms_mean": ms,
            "latency_ms_p50": ms,
            "latency_ms_p99": 2 * ms,
        }
        for way, returns in acting.items()
    }
    (folder / "evaluation.json").write_text(json.dumps(evaluation))
    if error is not None:
        (folder / "prediction.json").write_text(json.dumps({"coverage_median": error}))
    return folder


def results(runs: Path) -> Results:
    found = read_runs(runs)
    assert not found.problems
    return Results(found.runs)


def make(tmp_path: Path, runs: Path | None = None, **changes) -> Report:
    config = ReportConfig(
        runs=str(runs or tmp_path / "runs"),
        sensitivity=str(tmp_path / "sensitivity"),
        latency=str(tmp_path / "latency"),
        out=str(tmp_path / "report"),
        reps=50,
        overview=str(tmp_path / "overview.md"),
    )
    return make_report(replace(config, **changes))


def table(tmp_path: Path, name: str) -> list[dict[str, str]]:
    with (tmp_path / "report" / "tables" / f"{name}.csv").open() as file:
        return list(csv.DictReader(file))


def text(made: Report, title: str) -> str:
    return next(section.text for section in made.sections if section.title == title)
