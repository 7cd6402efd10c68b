"""Write an agent's planner as an AOTInductor package and as an ONNX model, and check both.

    python recipes/export.py agent=results/agents/pendulum-swingup out=outputs/export

The same as ``phihp export``; ``--help`` prints every setting.
"""

from __future__ import annotations

from phihp_torchrl.commands import main

if __name__ == "__main__":
    main(command="export")
