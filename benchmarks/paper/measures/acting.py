"""Who plays for the agent in what an evaluation has kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def agent_in(played: Mapping[str, Any]) -> str:
    """The way of acting that is the agent's: its plans, unless calibration let the actor act.

    Args:
        played: what was played, by way of acting, ``"planner"`` or ``"actor"``.

    Examples:
        >>> agent_in({"planner": [1.0], "actor": [2.0]}), agent_in({"actor": [2.0]})
        ('planner', 'actor')
    """
    return "planner" if "planner" in played else "actor"
