"""Plain CEM in the world itself (CEM-oracle), in a hybrid model (Ph-CEM) or without prior (dd-CEM).

python recipes/cem.py task=pendulum-swingup method=ph-cem

``config/cem.yaml`` has more examples; ``--help`` and ``--cfg job`` print every key.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig
from phihp import launch


@hydra.main(version_base="1.3", config_path="config", config_name="cem")
def main(composed: DictConfig) -> None:
    """Run the phases, and print what the agent earned."""
    launch(composed)


if __name__ == "__main__":
    main()
