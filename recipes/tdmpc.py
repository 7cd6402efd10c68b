"""TD-MPC (Hansen et al., 2022): latent model, policy and Q from real steps, planning by MPPI.

python recipes/tdmpc.py task=pendulum-swingup preset=default

``config/tdmpc.yaml`` has more examples; ``--help`` and ``--cfg job`` print every key.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig
from phihp import launch


@hydra.main(version_base="1.3", config_path="config", config_name="tdmpc")
def main(composed: DictConfig) -> None:
    """Run the phases, and print what the agent earned."""
    launch(composed)


if __name__ == "__main__":
    main()
