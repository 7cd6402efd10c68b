"""Run a grid, methods x tasks x seeds x shares of the published samples, wherever there is room.

    python benchmarks/paper/run_grid.py method=phihp task=pendulum,acrobot seed=0,1,2 share=1,0.1
    python benchmarks/paper/run_grid.py task=pendulum,acrobot 'seed=range(5)' launcher=joblib jobs=2

A finished cell is skipped, and refused if its settings are not those of now; one that was cut off
goes on from its checkpoint, one that failed is reported. ``config/grid.yaml`` has more examples,
and every key. What is kept of the runs is in results/trials/, and of the last proof's in
results/runs/; ``make_report.py`` makes tables and figures of either.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from grid import GridConfig, work
from phihp_torchrl.config import ConfigError, from_mapping


@hydra.main(version_base="1.3", config_path="config", config_name="grid")
def main(composed: DictConfig) -> str:
    """Work on one cell of the grid; the launcher decides where."""
    mapping: Any = OmegaConf.to_container(composed, resolve=True)
    try:
        config = from_mapping(GridConfig, mapping)
    except ConfigError as error:
        sys.exit(f"error: {error}")
    try:
        return work(config, Path(HydraConfig.get().runtime.cwd)).status.value
    except ConfigError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    # Before workers start: two threads on two busy cores are many times slower, not faster.
    os.environ["OMP_NUM_THREADS"] = "1"
    # They import `grid` too, from beside this file.
    paths = [str(Path(__file__).parent.absolute()), os.environ.get("PYTHONPATH")]
    os.environ["PYTHONPATH"] = os.pathsep.join(path for path in paths if path)
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("Stopped. The same command goes on with it.")
