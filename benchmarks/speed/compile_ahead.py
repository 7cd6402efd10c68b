"""The time to the first update of a compiled policy phase, with another process that compiles it.

    python benchmarks/speed/compile_ahead.py

Runs of the paper's preset with few updates, each in a process of its own with an empty cache of the
compiler, take turns: where another process compiles while the model is learned, and where none
does. Writes results/compile_ahead. It asks for two idle cores; times are of the clock on the wall.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from os import environ
from pathlib import Path
from statistics import median

from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text

RESULTS = Path("results/compile_ahead")
# A shorter first phase, and nothing of the second but its first updates.
SETTINGS = (
    "task=pendulum-swingup",
    "preset=paper",
    "compile=true",
    "phases=[model,policy]",
    "model.real_steps=1500",
    "policy.updates=64",
    "policy.evaluation_interval=64",
    "policy.refit.interval=0",
    "progress=false",
)
_RUN = """
import sys
from phihp_torchrl.trainers import compile_ahead
idle = sys.argv.pop(1) == "ahead"
compile_ahead.has_idle_core = lambda threads, begun: idle
from phihp_torchrl.commands import main
main()
"""


def seconds(way: str) -> dict[str, float]:
    """Seconds of each phase of a run, and of all of it."""
    with tempfile.TemporaryDirectory(prefix="phihp-ahead-") as place:
        run = Path(place, "run")
        words = [sys.executable, "-c", _RUN, way, "train", *SETTINGS, f"run_dir={run}"]
        start = time.monotonic()
        cache = {"TORCHINDUCTOR_CACHE_DIR": f"{place}/cache", "OMP_NUM_THREADS": "1"}
        subprocess.run(words, check=True, env={**environ, **cache}, stdout=subprocess.DEVNULL)
        whole = time.monotonic() - start
        phases = json.loads((run / "metadata.json").read_text())["seconds"]
    return {**phases, "in all": whole}


def main() -> None:
    """Let both take turns, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=int, default=3)
    options = parser.parse_args()
    found: dict[str, list[dict[str, float]]] = {"ahead": [], "by itself": []}
    for _ in range(options.turns):
        for way, runs in found.items():
            runs.append(seconds(way))
            print(way, runs[-1], flush=True)
    columns = ("model", "policy", "in all")
    rows = [[way, *(f"{median(run[c] for run in runs):.0f}" for c in columns)]
            for way, runs in found.items()]  # fmt: skip
    saved = [b["in all"] - a["in all"] for a, b in zip(*found.values(), strict=True)]
    text = (
        "# The policy phase compiled ahead\n\nMade by `python benchmarks/speed/compile_ahead.py` "
        f"({origin_text(describe_origin(0))}). Do not edit. Seconds on the clock, medians of "
        f"{options.turns} runs of each kind that took turns, with an empty cache: "
        f"`phihp train {' '.join(SETTINGS)}`. *ahead*: another process compiles while the model is "
        f"learned. It saves {min(saved):.0f} to {max(saved):.0f} s.\n\n"
        f"{markdown_table(['compiled', *columns], rows)}\n"
    )
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "README.md").write_text(text)
    (RESULTS / "compile_ahead.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
