"""TD3 on real steps, the model-free baseline.

    python recipes/td3.py task=pendulum-swingup

The same as ``phihp train method=td3``; ``--help`` prints the settings that matter most.
"""

from __future__ import annotations

from phihp_torchrl.commands import main

if __name__ == "__main__":
    main(command="train", method="td3")
