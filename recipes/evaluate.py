"""Play a trained agent: returns, latency, a picture and a GIF.

    python recipes/evaluate.py agent=results/agents/acrobot episodes=50

The same as ``phihp evaluate``; ``--help`` prints every setting.
"""

from __future__ import annotations

from phihp_torchrl.commands import main

if __name__ == "__main__":
    main(command="evaluate")
