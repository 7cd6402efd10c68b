"""Plain CEM in the world itself (cem-oracle), in a hybrid model (ph-cem) or without prior (dd-cem).

    python recipes/cem.py task=pendulum-swingup method=ph-cem

The same as ``phihp train method=cem-oracle``; ``--help`` prints the settings that matter most.
"""

from __future__ import annotations

from phihp_torchrl.commands import main

if __name__ == "__main__":
    main(command="train", method="cem-oracle")
