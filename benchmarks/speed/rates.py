"""How long phases took in committed runs, for the expected duration that a run says first.

    python benchmarks/speed/rates.py [results/runs ...]

It writes ``phihp_torchrl/trainers/rates.json``: by method, preset, task and phase, the 10th, 50th
and 90th percentile over runs of the seconds for each unit of the setting that says how much work
there is. The evaluation's time hardly depends on its episodes, which are played as a batch.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from pathlib import Path
from statistics import median, quantiles

import yaml

from phihp_torchrl.origin import machine_text

PER = {"model": "real_steps", "policy": "updates", "td3": "real_steps", "tdmpc": "real_steps"}
"""The setting of a phase to which its time is proportional."""
FILE = Path(__file__).parents[2] / "phihp_torchrl" / "trainers" / "rates.json"


def main(places: list[str]) -> None:
    """Read finished runs in directories, and write the file."""
    found: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    versions, machines, count = set(), set(), 0
    for path in sorted(p for place in places for p in Path(place).glob("*/metadata.json")):
        metadata = json.loads(path.read_text())
        config = yaml.safe_load((path.parent / "config.yaml").read_text())
        if "seconds" not in metadata or len(metadata["sessions"]) != 1:
            continue
        count += 1
        session = metadata["sessions"][0]
        versions.add(session["versions"]["phihp_torchrl"])
        machines.add(machine_text(session))
        key = "/".join((config.get("method", "phihp"), config["preset"], config["task"]))
        for phase, seconds in metadata["seconds"].items():
            amount = config[phase][PER[phase]] if phase in PER else 1
            if amount:
                found[key][phase].append(seconds / amount)
    rates = {
        "from": {"runs": count, "versions": sorted(versions), "machines": sorted(machines)},
        "per": PER,
        "seconds": {
            key: {phase: _three(values) for phase, values in of.items()}
            for key, of in sorted(found.items())
        },
    }
    FILE.write_text(json.dumps(rates, indent=1) + "\n")


def _three(values: list[float]) -> list[float]:
    if len(values) == 1:
        return [float(f"{values[0]:.4g}")] * 3
    tenths = quantiles(values, n=10, method="inclusive")
    return [float(f"{v:.4g}") for v in (tenths[0], median(values), tenths[-1])]


if __name__ == "__main__":
    main(sys.argv[1:] or ["results/runs"])
