"""Run the last proof, stage by stage: what the claims need most comes first.

    python benchmarks/paper/proof.py only_plan=true    # notes all cells in planned.json, runs none
    python benchmarks/paper/proof.py
    python benchmarks/paper/proof.py --stages cem td3 launcher=joblib jobs=2

Each stage is a grid (``run_grid.py``) with ``proof=true``, and words that are given here are given
to all of them. A command that was cut off goes on where it was, and several may run at once. Times
of an action are no grid: ``latency.py``. Whatever is finished stands, and a report says of each
cell that was planned whether it is done.
"""

from __future__ import annotations

import argparse
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

The three CEMs have the paper's budget by themselves. TD-MPC's networks and candidates by default
are about a quarter of the published ones, which take a quarter of a second for an action here.
"""


def main() -> None:
    """Run the stages that are asked for, or all; stop at the first that fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stages", nargs="+", metavar="STAGE", choices=STAGES, default=[*STAGES])
    options, words = parser.parse_known_args()
    script = str(Path(__file__).with_name("run_grid.py"))
    # A grid says itself what is wrong with its words.
    wrong = [word for word in words if "=" not in word]
    if wrong:
        parser.error(f"expected a stage of {[*STAGES]} or a setting, got {wrong[0]!r}.")
    for stage in options.stages:
        print(f"stage {stage}", flush=True)
        code = subprocess.call([sys.executable, script, "proof=true", *STAGES[stage], *words])
        if code:
            sys.exit(code)


if __name__ == "__main__":
    main()
