"""Run a grid, methods x tasks x seeds x shares of the published samples, wherever there is room.

    python recipes/benchmark.py method=phihp task=pendulum,acrobot seed=0,1,2 share=1,0.1
    python recipes/benchmark.py task=pendulum,acrobot seed=range(5) launcher=joblib jobs=2

A finished cell is skipped, one that was cut off goes on from its checkpoint, one that failed is
reported. ``config/benchmark/benchmark.yaml`` has more examples, and every key; ``report.py`` makes
tables and figures of what is kept in results/runs/.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from phihp_torchrl.benchmark import BenchmarkConfig, work
from phihp_torchrl.trainers import ConfigError, from_mapping


@hydra.main(version_base="1.3", config_path="config/benchmark", config_name="benchmark")
def main(composed: DictConfig) -> str:
    """Work on one cell of the grid; the launcher decides where."""
    runtime = HydraConfig.get().runtime
    # Beside the recipes' own configurations, where `task` is a choice of files.
    recipes = next(source.path for source in runtime.config_sources if source.provider == "main")
    try:
        config = from_mapping(BenchmarkConfig, OmegaConf.to_container(composed, resolve=True))
    except ConfigError as error:
        sys.exit(f"error: {error}")
    return work(config, Path(recipes).parent, Path(runtime.cwd)).status.value


if __name__ == "__main__":
    # Before workers start: two threads on two busy cores are many times slower, not faster.
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("Stopped. The same command goes on with it.")
