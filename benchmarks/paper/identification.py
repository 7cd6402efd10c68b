"""What ``identify`` and plain grey-box fits with SciPy make of the same three logs.

    python benchmarks/paper/identification.py

Reads tests/cases/*.csv as ``phihp identify`` does, with the plugins in benchmarks/paper/rigs, fits
them by ``identify`` and by the three fits of greybox.py, and compares with tests/cases/truth.json.
Writes results/identification/<log>.json after each log, and a README.md beside them.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch

import greybox
from phihp_torchrl.config import load_config, read_kind
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.identification import Identification, identify
from phihp_torchrl.origin import commit_text, describe_origin, machine_text
from phihp_torchrl.recordings import Recording, read_recordings
from phihp_torchrl.tasks import Task, get_task
from phihp_torchrl.trainers import import_plugins
from phihp_torchrl.worlds import WORLDS

CASES, RIGS = Path("tests/cases"), Path("benchmarks/paper/rigs")
RESULTS = Path("results/identification")
OURS = "identify"
WHOLE, PIECES, STEPS = "single shooting", "shooting in pieces", "one-step regression"
PEERS = (WHOLE, PIECES, STEPS)
Numbers = Mapping[str, float]


def of_pendulum(c: Numbers) -> dict[str, float]:
    """What motion tells of the pendulum."""
    inertia = c["mass"] * c["length"] ** 2 / 3.0
    shares = {f"{n}/inertia": c[n] / inertia for n in ("gain", "viscous", "coulomb")}
    return {**shares, "1.5 g/l": 1.5 * greybox.GRAVITY / c["length"]}


def of_tanks(c: Numbers) -> dict[str, float]:
    """What levels tell of the tanks."""
    return {f"{n}/area_1": c[n] / c["area_1"] for n in ("area_2", "outlet_1", "outlet_2", "flow")}


class Case(NamedTuple):
    """A log, the plugin of its rig, and what can be had from it."""

    plugin: str
    equations: greybox.Equations
    quantities: Callable[[Numbers], dict[str, float]]

    @property
    def task(self) -> str:
        """Name of the task that the plugin registers."""
        return self.plugin.replace("_", "-")


CASES_BY_LOG = {
    "pendulum": Case("geared_pendulum", greybox.pendulum, of_pendulum),
    "tanks": Case("two_tanks", greybox.tanks, of_tanks),
    "rail": Case("short_rail", greybox.rail, dict),
}


def read(log: str) -> tuple[Task, list[Recording]]:
    """The task and the recordings, as the command reads them."""
    case = CASES_BY_LOG[log]
    import_plugins([f"{RIGS / case.plugin}.py"])
    lines = ["world=recorded", f"world.files={CASES / log}.csv"]
    settings = load_config(case.task, overrides=lines, config_dir=RIGS)
    world: Any = read_kind(WORLDS, settings["world"], "world")
    task = get_task(case.task)
    return task, read_recordings(task, world.files, world.columns, gap=world.gap).recordings


def fit_ours(task: Task, logs: list[Recording]) -> dict[str, Any]:
    """Fit once."""
    begun = time.process_time()
    found = identify(task, logs)
    seconds = time.process_time() - begun
    constants = {name: c.estimate for name, c in found.constants.items()}
    return {"cpu_s": seconds, "constants": constants, "found": found}


def fit_peer(name: str, case: Case, task: Task, logs: list[Recording]) -> dict[str, Any]:
    """Fit once."""
    begun = time.process_time()
    system = task.system
    index = system.state_names.index
    velocity_of = {index(q): index(v) for q, v in system.velocity_of.items()}
    guess = np.array([float(value) for value in system.constants.values()])
    parts = greybox.in_pieces(logs) if name == PIECES else logs
    fit = greybox.one_step if name == STEPS else greybox.single_shooting
    found = fit(case.equations, greybox.gather(parts, velocity_of), guess)
    seconds = time.process_time() - begun
    constants = dict(zip(system.constants, found.constants.tolist(), strict=True))
    ended = {"message": found.message, "evaluations": found.evaluations}
    return {"cpu_s": seconds, "constants": constants, **ended}


def errors(constants: Numbers, truth: Numbers, case: Case) -> dict[str, float]:
    """Relative errors of what can be had from the log."""
    made = {name: truth[name] for name in constants}
    estimates, values = case.quantities(constants), case.quantities(made)
    return {name: abs(estimates[name] / value - 1.0) for name, value in values.items()}


def describe(found: Identification) -> dict[str, Any]:
    """What else ``identify`` says."""
    plain = found.to_json()
    path = {"delay_steps": found.actuator.delay_steps, "lag_s": found.actuator.lag_s}
    kept = ("constants", "combinations", "noise", "stops", "warnings")
    return {**path, **{key: plain[key] for key in kept}, "floor_ratio_20": _floor(found)}


def _floor(found: Identification) -> float:
    return found.errors["20"].floor_ratio


def compare(log: str, repeats: int) -> dict[str, Any]:
    """Fit a log in every way, by ``identify`` again for its time."""
    case = CASES_BY_LOG[log]
    truth = json.loads((CASES / "truth.json").read_text())[log]
    task, logs = read(log)
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in (OURS, *PEERS)}
    for peer in PEERS:
        runs[peer].append(fit_peer(peer, case, task, logs))
    for _ in range(repeats):
        runs[OURS].append(fit_ours(task, logs))
    said = describe(runs[OURS][0].pop("found"))
    result = {}
    for name, fits in runs.items():
        last = {key: value for key, value in fits[-1].items() if key not in ("cpu_s", "found")}
        wrong = errors(last["constants"], truth, case)
        result[name] = {"errors": wrong, "cpu_s": [fit["cpu_s"] for fit in fits], **last}
    return {
        "log": log,
        "samples": sum(len(r) for r in logs),
        "truth": truth,
        "fits": result,
        "identify": said,
        "origin": describe_origin(0),
    }


def rows_of(result: Mapping[str, Any]) -> list[list[str]]:
    """A row for each quantity, and one for the time."""
    fits = result["fits"]
    rows = [
        [result["log"], name, *(_percent(fit["errors"][name]) for fit in fits.values())]
        for name in fits[OURS]["errors"]
    ]
    times = [median(fit["cpu_s"]) for fit in fits.values()]
    base = median(fits[WHOLE]["cpu_s"])
    return [*rows, [result["log"], "time / single shooting", *(f"{t / base:.3g}" for t in times)]]


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"


def write_readme(results: Path) -> None:
    """The table of all logs so far."""
    every = [json.loads(path.read_text()) for path in sorted(results.glob("*.json"))]
    rows = [row for result in every for row in rows_of(result)]
    path = [
        [
            r["log"],
            str(r["samples"]),
            f"{r['identify']['delay_steps'] or 0.0:g} ({r['truth'].get('delay', 0)})",
            f"{r['identify']['lag_s'] or 0.0:.3g} ({r['truth'].get('lag', 0.0):g})",
            f"{r['identify']['floor_ratio_20']:.3g}",
            str(len(r["fits"][OURS]["cpu_s"])),
        ]
        for r in every
    ]
    commits = sorted({commit_text(r["origin"]) for r in every})
    machines = sorted({machine_text(r["origin"]) for r in every})
    columns = ["log", "samples", "delay, steps (true)", "lag, s (true)"]
    columns += ["error over 20 steps / noise", "repeats"]
    text = (
        "# Identification beside plain grey-box fits\n\n"
        "Made by `python benchmarks/paper/identification.py`. Do not edit. Relative errors of what "
        "each log can tell, against what made it. *identify* is `phihp_torchrl.identification` "
        "with its defaults. *Single shooting* simulates each uninterrupted stretch from a fitted "
        "start, *shooting in pieces* does so with stretches cut into 50 samples at most, and "
        "*one-step regression* predicts each sample from the one before, all by "
        "`scipy.optimize.least_squares`; they know nothing of delay, lag and stops, and give no "
        "report. Times are processor seconds with one thread, of *identify* the median over "
        "repeats, as ratios to single shooting in the same run. *identify* tries paths of the "
        "command and integrators, fits twice and judges the predictions in its time.\n\n"
        f"{markdown_table(['log', 'quantity', OURS, *PEERS], rows)}\n"
        f"## What identify found besides\n\n{markdown_table(columns, path)}\n"
        f"Commits: {', '.join(commits)}. Machines: {'; '.join(machines)}, shared with other work; "
        "one thread.\n"
    )
    (results / "README.md").write_text(text)


def main(words: Sequence[str] | None = None) -> None:
    """Fit, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", nargs="+", choices=CASES_BY_LOG, default=list(CASES_BY_LOG))
    parser.add_argument("--repeats", type=int, default=3, help="fits by identify")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args(words)
    torch.set_num_threads(1)
    arguments.results.mkdir(parents=True, exist_ok=True)
    for log in arguments.logs:
        result = compare(log, arguments.repeats)
        path = arguments.results / f"{log}.json"
        path.write_text(json.dumps(result, indent=1) + "\n")
        write_readme(arguments.results)
        for row in rows_of(result):
            print(*row, sep=" | ", flush=True)


if __name__ == "__main__":
    main()
