"""TD3 on real steps, the model-free baseline.

python recipes/td3.py task=pendulum-swingup

``config/td3.yaml`` has more examples; ``--help`` and ``--cfg job`` print every key.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig
from phihp import launch


@hydra.main(version_base="1.3", config_path="config", config_name="td3")
def main(composed: DictConfig) -> None:
    """Run the phases, and print what the agent earned."""
    launch(composed)


if __name__ == "__main__":
    main()
