"""Watch an agent learn to swing a pendulum up, from 2,500 real steps.

    python recipes/demo.py            # or: make demo

It learns as ``phihp train`` does with the default preset, nothing prepared beforehand, and puts a
picture and a GIF into ``outputs/demo``. Words are settings: ``python recipes/demo.py seed=1``.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from torchrl.checkpoint import CheckpointError

from phihp_torchrl.commands import tell
from phihp_torchrl.config import ConfigError, compose_yaml
from phihp_torchrl.trainers import read_request, run

TASK = "pendulum-swingup"
OUTPUT = Path("outputs/demo")


def main(words: list[str]) -> None:
    """Learn PendulumSwingup and show it."""
    words = [f"task={TASK}", *words]
    print(f"{TASK}: a model from real steps, a policy from the model, planning with both.\n")
    try:
        request = read_request(compose_yaml(words), words)
        result = run(request.config, request.path, resume=request.resume)
    except (ConfigError, CheckpointError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
    tell(result)
    OUTPUT.mkdir(parents=True, exist_ok=True)
    for source in sorted(result.path.glob("episode.*")):
        shutil.copyfile(source, OUTPUT / source.name)
        print(f"wrote {OUTPUT / source.name}")


if __name__ == "__main__":
    main(sys.argv[1:])
