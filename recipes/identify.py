"""Fit the constants of a task's system to recordings, or to real steps, and report on them.

    python recipes/identify.py task=my-rig world=recorded world.files=logs/*.csv

The same as ``phihp identify``; ``--help`` prints every setting.
"""

from __future__ import annotations

from phihp_torchrl.commands import main

if __name__ == "__main__":
    main(command="identify")
