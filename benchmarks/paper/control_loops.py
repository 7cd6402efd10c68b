"""Missed deadlines of control loops through a socket, at 50 and 200 Hz, by plan and by actor.

    python benchmarks/paper/control_loops.py

Runs the recipe socket_loop: a simulated plant in a process of its own, which does not wait. Writes
results/realtime/: a table, and everything as JSON. Other work on the machine makes a loop late, so
the load before and after is written beside the figures.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "recipes"))

from socket_loop import control

from phihp_torchrl.deployment import Controller, Safety, load_agent, simulated_plant
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text

RESULTS = Path("results/realtime")
ACTING = ("plan", "compiled plan", "actor")
SHARE = 0.75  # of a tick, within which the agent must have acted


def measure(path: Path, acting: str, rates: list[float], seconds: float) -> list[dict[str, Any]]:
    """What a loop at each rate says, as JSON values."""
    compiled = acting == "compiled plan"
    agent, rows = load_agent(path, planner=acting != "actor", compile=compiled), []
    for rate in rates:
        safety = Safety(deadline=SHARE / rate, max_age=SHARE / rate)
        controller = Controller(agent, safety=safety, clock=time.monotonic)
        controller.warm_up()
        with simulated_plant(agent.task.name, rate, seconds) as line:
            ticks, missed = control(controller, line)
        report, load = controller.report(), os.getloadavg()[0]
        found = {"acting": acting, "hz": rate, "ticks": ticks, "missed": missed, "load": load}
        rows.append({**found, **report.summary(), "reasons": dict(report.reasons)})
        controller.close()
    return rows


def page(entry: dict[str, Any]) -> str:
    """The results as a page."""
    rows = []
    for row in entry["rows"]:
        reasons = ", ".join(f"{name} {n}" for name, n in sorted(row["reasons"].items())) or "–"
        times = [f"{row[name]:.2f}" for name in ("p50_ms", "p99_ms")]
        counts = [f"{row['hz']:g}", str(row["ticks"]), str(row["missed"])]
        rows.append([row["acting"], *counts, reasons, *times, f"{row['load']:.1f}"])
    header = ["agent", "Hz", "ticks", "missed", "taken over", "p50 ms", "p99 ms", "load"]
    before = ", ".join(f"{each:.1f}" for each in entry["load_before"])
    return (
        "# Control loops through a socket\n\n"
        "Made by `python benchmarks/paper/control_loops.py`; do not edit. The agent is "
        f"`{entry['agent']}`, one thread, torch {entry['origin']['versions']['torch']}.\n\n"
        f"Made at {origin_text(entry['origin'])}. Load averages before (1, 5 and 15 "
        f"minutes): {before}; each row has that of the last minute at its end. Above the number of "
        "cores, other work took part of the time, and these figures are upper bounds.\n\n"
        f"{markdown_table(header, rows)}\n\n"
        "*missed*: ticks of the plant at which no new command had come. *taken over*: steps of "
        "another controller (the actor, or the last action), by reason: `late`, the agent had not "
        f"acted within {SHARE:g} of a tick; `stale`, the sample was older than that when it was "
        "read. *p50* and *p99* are of the time from a sample to its command.\n"
    )


def main() -> None:
    """Measure, and write what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agent", type=Path, default=Path("results/agents/pendulum-swingup"))
    parser.add_argument("--acting", nargs="+", choices=ACTING, default=list(ACTING))
    parser.add_argument("--rates", nargs="+", type=float, default=[50.0, 200.0], help="in Hz")
    parser.add_argument("--seconds", type=float, default=20.0, help="at each rate")
    parser.add_argument("--out", type=Path, default=RESULTS)
    words = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    entry: dict[str, Any] = {
        "agent": str(words.agent),
        "seconds": words.seconds,
        "origin": describe_origin(seed=0),
        "load_before": os.getloadavg(),
        "rows": [],
    }
    words.out.mkdir(parents=True, exist_ok=True)
    for acting in words.acting:
        entry["rows"] += measure(words.agent, acting, words.rates, words.seconds)
        text = json.dumps(entry, indent=1)
        (words.out / "realtime.json").write_text(text + "\n")
        (words.out / "README.md").write_text(page(entry))


if __name__ == "__main__":
    main()
