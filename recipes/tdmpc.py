"""TD-MPC, the model-based baseline that learns everything from real steps.

    python recipes/tdmpc.py task=pendulum-swingup

The same as ``phihp train method=td-mpc``; ``--help`` prints the settings that matter most.
"""

from __future__ import annotations

from phihp_torchrl.commands import main

if __name__ == "__main__":
    main(command="train", method="td-mpc")
