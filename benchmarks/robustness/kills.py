"""A run is killed anywhere, resumed, and must end as if nothing had happened.

    python benchmarks/robustness/kills.py                # 40 at random times, 40 at operations
    python benchmarks/robustness/kills.py --kills 4

A run of all phases, as small as one can be, is killed (SIGKILL) at random times, and before its
operations on files one after the other, and resumed: states, rows, agent and evaluation must be
those of a run which nothing disturbed, bit by bit. Writes results/robustness/kills.json.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from found import write_part
from phihp_torchrl.trainers import RunConfig
from small_run import child, outcome, prepare, wait, whole_run

AT_RANDOM, BEFORE_OPERATION = "at a random time", "before an operation on files"
SAME = "resumed, equal to the bit"


def main() -> None:
    """Kill, resume and compare, and write what became of each after every pair."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=40, help="of each of the two kinds")
    count = parser.parse_args().kills
    config = prepare()
    killed: dict[str, Counter[str]] = {kind: Counter() for kind in (AT_RANDOM, BEFORE_OPERATION)}
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        seconds, operations = whole_run(config, place / "whole")
        draw, expected = random.Random(0), outcome(place / "whole")
        for number in range(count):
            harms: dict[str, dict[str, Any]] = {
                AT_RANDOM: {"after": draw.uniform(0, seconds)},
                BEFORE_OPERATION: {"step": 1 + number * operations // count},
            }
            for kind, harm in harms.items():
                killed[kind][survives(config, place / "killed", expected, **harm)] += 1
                shutil.rmtree(place / "killed", ignore_errors=True)
            record = {
                "seconds_of_a_run": round(seconds, 1),
                "operations_on_files": operations,
                "kills": {name: dict(counts) for name, counts in killed.items()},
            }
            write_part("kills", record)
    print(record["kills"])


def survives(
    config: RunConfig,
    path: Path,
    expected: dict[str, Any],
    *,
    after: float | None = None,
    step: int | None = None,
) -> str:
    """Kill a run after seconds, or before an operation; resume it, and say how it ended."""
    with child(config, path, operation=step) as pid:
        if after is not None:
            time.sleep(after)
            os.kill(pid, signal.SIGKILL)
        if wait(pid) == 0:
            return "ended before it was killed"
    with child(config, path) as pid:
        if wait(pid) != 0:
            return "lost: it could not be resumed"
    return SAME if outcome(path) == expected else "lost: it ended otherwise"


if __name__ == "__main__":
    main()
