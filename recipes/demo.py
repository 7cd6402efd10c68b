"""Watch an agent learn to swing a pendulum up, from 2,500 real steps.

    python recipes/demo.py            # or: make demo

It learns as ``phihp train`` does with the default preset, nothing prepared beforehand, plays 20
episodes that it has not met, and puts page and pictures into ``outputs/demo``. Words are settings:
``python recipes/demo.py seed=1``.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from phihp_torchrl.commands import use_utf8
from phihp_torchrl.display import loading

TASK = "pendulum-swingup"
FEWER = ("evaluate.episodes=20", "evaluate.packaged=false")
OUTPUT = Path("outputs/demo")
FIRST = (
    f"{TASK}: from nothing, it takes real steps, fits a model to them, learns a policy in the "
    "model,\nand plans with both. Loading PyTorch and TorchRL first, which takes some seconds."
)


def main(words: list[str]) -> None:
    """Learn PendulumSwingup and show it."""
    try:
        with loading(FIRST):
            learn([f"task={TASK}", *FEWER, *words])
    except KeyboardInterrupt:
        sys.exit(130)


def learn(words: list[str]) -> None:
    """Learn as the words say, and put the pictures where they are easily found."""
    from torchrl.checkpoint import CheckpointError

    from phihp_torchrl.commands import show_log, tell
    from phihp_torchrl.config import ConfigError, compose_yaml, file_error
    from phihp_torchrl.trainers import read_request, run

    show_log()
    try:
        request = read_request(compose_yaml(words), words)
        result = run(request.config, request.path, resume=request.resume)
    except (ConfigError, CheckpointError) as error:
        sys.exit(f"error: {error}")
    except OSError as error:  # a full disk, a folder without permission, ...
        sys.exit(f"error: {file_error(error)}")
    OUTPUT.mkdir(parents=True, exist_ok=True)
    tell(result)
    for name in ("report.html", "episode.png", "episode.gif"):
        if (result.path / name).is_file():
            shutil.copyfile(result.path / name, OUTPUT / name)
            print(f"wrote {OUTPUT / name}")


if __name__ == "__main__":
    use_utf8()
    main(sys.argv[1:])
