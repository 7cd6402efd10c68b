"""PhIHP: learn a model from real steps, a policy in the model, and act with both.

python recipes/phihp.py task=pendulum-swingup seed=0

``config/phihp.yaml`` has more examples, and every key; ``--help`` and ``--cfg job`` print it.
"""

from __future__ import annotations

import sys

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torchrl.checkpoint import CheckpointError

from phihp_torchrl.evaluation import returns_table
from phihp_torchrl.trainers import ConfigError, RunResult, read_request, read_result, run


@hydra.main(version_base="1.3", config_path="config", config_name="phihp")
def main(composed: DictConfig) -> None:
    """Run the phases, and print what the agent earned."""
    launch(composed)


def launch(composed: DictConfig) -> None:
    """Run what Hydra composed, whatever its method."""
    try:
        request = read_request(composed, HydraConfig.get().overrides.task)
        result = run(request.config, request.path, resume=request.resume)
    except (ConfigError, CheckpointError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
    report(result)


def report(result: RunResult) -> None:
    """Print the table of returns, or how to go on."""
    if result.signal is not None and not result.finished:
        print(f"\nStopped. Go on with: python {sys.argv[0]} resume={result.path}")
        sys.exit(128 + result.signal)
    earned = read_result(result.path)
    if earned is not None:
        print(f"\n{returns_table([earned])}")
    print(f"Everything is in {result.path}")


if __name__ == "__main__":
    main()
