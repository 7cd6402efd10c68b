"""The attributes that TorchRL's planners have, as views of a planner's settings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from phihp_torchrl.planners.search import SearchConfig


class Setting:
    """A number of the settings as an attribute, which may be assigned."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, planner: Any, owner: type | None = None) -> Any:
        return self if planner is None else getattr(planner.settings, self.name)

    def __set__(self, planner: Any, value: Any) -> None:
        planner.settings = replace(planner.settings, **{self.name: value})


class StockAttributes:
    """The numbers of :class:`torchrl.modules.CEMPlanner` by the names that they have there."""

    settings: SearchConfig

    planning_horizon = Setting()
    optim_steps = Setting()
    num_candidates = Setting()
    top_k = Setting()
