"""PhIHP: learn a model from real steps, a policy in the model, and act with both.

    python recipes/phihp.py task=pendulum-swingup seed=0

The same as ``phihp train``; ``--help`` prints the settings that matter most.
"""

from __future__ import annotations

from phihp_torchrl.commands import main

if __name__ == "__main__":
    main(command="train")
