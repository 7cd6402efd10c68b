"""How long phases took in committed runs, for the expected duration that a run says first.

    python benchmarks/speed/rates.py [results/runs-0.1.0 results/runs results/times ...]

It writes ``phihp_torchrl/trainers/rates.json``: by method, preset, task and phase, the 10th, 50th
and 90th percentile over runs of the seconds for each unit of the setting that says how much work
there is. Where several directories have runs of a method, preset and task, the last that is named
decides: it has the newest. An evaluation's time is that of the usual number of episodes, which are
played as a batch. Of runs with several numbers of real steps those with the most common one count.
"""

from __future__ import annotations

import json
import sys
from collections import Counter, defaultdict
from pathlib import Path
from statistics import median, quantiles
from typing import Any

import yaml

from phihp_torchrl.origin import machine_text

PER = {"model": "real_steps", "policy": "updates", "td3": "real_steps", "tdmpc": "real_steps"}
"""The setting of a phase to which its time is proportional."""
FILE = Path(__file__).parents[2] / "phihp_torchrl" / "trainers" / "rates.json"


def main(places: list[str]) -> None:
    """Read finished runs in directories, and write the file."""
    found: dict[str, dict[str, list[float]]] = {}
    about: dict[str, list[dict[str, Any]]] = {}
    for place in places:
        here: dict[str, dict[str, list[tuple[int, float]]]] = defaultdict(lambda: defaultdict(list))
        sessions: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for path in sorted(Path(place).glob("*/metadata.json")):
            metadata = json.loads(path.read_text())
            config = yaml.safe_load((path.parent / "config.yaml").read_text())
            if "seconds" not in metadata or len(metadata["sessions"]) != 1:
                continue
            key = "/".join((config.get("method", "phihp"), config["preset"], config["task"]))
            sessions[key] += metadata["sessions"]
            for phase, seconds in metadata["seconds"].items():
                amount = config[phase][PER[phase]] if phase in PER else 1
                if amount:
                    here[key][phase].append((amount, seconds / amount))
        found |= {
            key: {phase: _usual(values) for phase, values in of.items()} for key, of in here.items()
        }
        about |= sessions
    used = [session for of in about.values() for session in of]
    versions = {session["versions"]["phihp_torchrl"] for session in used}
    machines = {machine_text(session) for session in used}
    rates = {
        "from": {"runs": len(used), "versions": sorted(versions), "machines": sorted(machines)},
        "per": PER,
        "seconds": {
            key: {phase: _three(values) for phase, values in of.items()}
            for key, of in sorted(found.items())
        },
    }
    FILE.write_text(json.dumps(rates, indent=1) + "\n")


def _usual(values: list[tuple[int, float]]) -> list[float]:
    """Seconds for a unit, of the amount of work that most runs have: a unit of few takes longer."""
    ((usual, _),) = Counter(amount for amount, _ in values).most_common(1)
    return [seconds for amount, seconds in values if amount == usual]


def _three(values: list[float]) -> list[float]:
    if len(values) == 1:
        return [float(f"{values[0]:.4g}")] * 3
    tenths = quantiles(values, n=10, method="inclusive")
    return [float(f"{v:.4g}") for v in (tenths[0], median(values), tenths[-1])]


if __name__ == "__main__":
    main(sys.argv[1:] or ["results/runs-0.1.0", "results/runs", "results/times"])
