"""Watch an agent learn to swing a pendulum up, from at most 5,000 real steps.

python recipes/demo.py            # or: make demo

It runs ``phihp.py`` with the default preset, nothing prepared beforehand, and puts a picture and a
GIF into ``outputs/demo``. Arguments are those of ``phihp.py``: ``python recipes/demo.py seed=1``.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from phihp import report
from torchrl.checkpoint import CheckpointError

from phihp_torchrl.trainers import ConfigError, read_request, run

TASK = "pendulum-swingup"
OUTPUT = Path("outputs/demo")


def main(arguments: list[str]) -> None:
    """Learn PendulumSwingup and show it."""
    overrides = [f"task={TASK}", *arguments]
    print(f"{TASK}: a model from real steps, a policy from the model, planning with both.\n")
    try:
        with initialize_config_dir(str(Path(__file__).parent / "config"), version_base="1.3"):
            composed = compose("phihp", overrides)
        request = read_request(composed, overrides)
        result = run(request.config, request.path, resume=request.resume)
    except (HydraException, ConfigError, CheckpointError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
    report(result)
    OUTPUT.mkdir(parents=True, exist_ok=True)
    for source in sorted(result.path.glob("episode.*")):
        shutil.copyfile(source, OUTPUT / source.name)
        print(f"wrote {OUTPUT / source.name}")


if __name__ == "__main__":
    main(sys.argv[1:])
