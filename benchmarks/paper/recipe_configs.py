"""The recipes' configurations, which the benchmarks compose, change and compare."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from phihp_torchrl.trainers import RunRequest, read_request

RECIPES = Path(__file__).parents[2] / "recipes"
"""Directory of the recipes."""

CONFIG = RECIPES / "config"
"""Directory of their configurations."""

sys.path.append(str(RECIPES))
from presets import settings  # noqa: E402  (there since the line above)

__all__ = ["CONFIG", "RECIPES", "compose_request", "settings"]

# For configurations here that take a group of the recipes': hydra.searchpath.
OmegaConf.register_new_resolver("recipe_configs", lambda: str(CONFIG), replace=True)


def compose_request(recipe: str, overrides: Sequence[str]) -> RunRequest:
    """What ``python recipes/<recipe>.py <overrides>`` would be asked for.

    Args:
        recipe: name of the recipe.
        overrides: its command line.

    Raises:
        ConfigError: for a value that is unknown or out of range, by its key.

    Examples:
        >>> compose_request("phihp", ["task=acrobot", "seed=3"]).config.seed
        3
    """
    lines = list(overrides)
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        return read_request(compose(recipe, lines), lines)
