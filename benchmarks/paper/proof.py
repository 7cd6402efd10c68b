"""Run the last proof, stage by stage: what the claims need most comes first.

    python benchmarks/paper/proof.py only_plan=true    # notes all cells in planned.json, runs none
    python benchmarks/paper/proof.py
    python benchmarks/paper/proof.py cem td3 launcher=joblib jobs=2
    git worktree add ../frozen frozen && python benchmarks/paper/proof.py clone=../frozen

Each stage is a grid (``run_grid.py``) with ``proof=true``, and words that are given here are given
to all of them. A command that was cut off goes on where it was, and several may run at once; with
Ctrl-C each stage ends by itself. Times of an action are no grid: ``latency.py``. Whatever is
finished stands, and a report says of each cell that was planned whether it is done.

All of a proof is the work of one commit. ``clone`` is the folder of a clone whose code makes the
cells, where this file is of a later commit; they are kept in this one's results/runs, or where
``results`` says.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from phihp_torchrl.evaluation import TARGETS

SIX = f"task={','.join(TARGETS)}"
TEN, FIVE, THREE = (f"seed=range(150,{150 + count})" for count in (10, 5, 3))
PAPER = 'overrides=["preset=paper","evaluate.video=false"]'
STAGES = {
    "phihp": [SIX, TEN],
    "cem": [SIX, FIVE, "method=cem-oracle,ph-cem,dd-cem"],
    "twin": [SIX, FIVE, "method=dd-phihp"],
    "tenth": [SIX, FIVE, "method=phihp,dd-phihp", "share=0.1"],
    "few": [SIX, FIVE, "method=phihp,dd-phihp", "share=0.02,0.05,0.01"],
    "all": [SIX, FIVE, "method=phihp,dd-phihp", "share=1"],
    "td3": [SIX, FIVE, "method=td3", "share=null", PAPER],
    "published-variant": ["task=cartpole-swingup-published", FIVE],
    "paper": [f"{SIX},cartpole-swingup-published", THREE, "share=1", "label=paper", PAPER],
    "td-mpc-star": [SIX, FIVE, "method=td-mpc-star,ph-td-mpc-star", "share=null"],
    "td-mpc": [SIX, FIVE, "method=td-mpc", "share=null"],
    "td-mpc-published": [
        "task=pendulum-swingup,acrobot",
        THREE,
        "method=td-mpc",
        "share=null",
        "label=paper",
        PAPER,
    ],
}
"""What makes each stage a grid of its own. Half of the published real samples, unless it says so.

The three CEMs have the paper's budget by themselves. TD-MPC's encoder by default has a half, its
other networks and candidates a quarter of the published sizes (``latency.py`` has both times).
"""


def main() -> None:
    """Run the stages that are asked for, or all; a stage with a cell that failed stops no other."""
    stages = [word for word in sys.argv[1:] if "=" not in word]
    given = dict(word.split("=", 1) for word in sys.argv[1:] if "=" in word)
    clone = Path(given.pop("clone", ".")).absolute()
    given.setdefault("results", str(Path("results/runs").absolute()))
    settings = [f"{key}={value}" for key, value in given.items()]
    for stage in stages:
        if stage not in STAGES:
            sys.exit(f"error: expected stages of {[*STAGES]} and settings, got {stage!r}.")
    script = str(clone / "benchmarks" / "paper" / "run_grid.py")
    environment = {**os.environ, "PYTHONPATH": str(clone)}
    failed = []
    for stage in stages or STAGES:
        print(f"stage {stage}", flush=True)
        words = [sys.executable, script, "proof=true", *STAGES[stage], *settings]
        if subprocess.call(words, cwd=clone, env=environment):
            failed.append(stage)
    if failed:
        sys.exit(f"Not all cells are done of the stages {', '.join(failed)}.")


if __name__ == "__main__":
    main()
