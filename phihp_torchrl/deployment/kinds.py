"""The kinds of agents that there are, and which one an agent or its file is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from phihp_torchrl.deployment import blueprint as phihp
from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.deployment.blueprint import Blueprint
from phihp_torchrl.deployment.tdmpc import TDMPCAgent, TDMPCBlueprint

AnyBlueprint = Blueprint | TDMPCBlueprint


def describe(agent: Agent) -> AnyBlueprint:
    """The blueprint of an agent; ``ValueError`` if some part is none of ours."""
    return TDMPCBlueprint.of(agent) if isinstance(agent, TDMPCAgent) else Blueprint.of(agent)


def modules(agent: Agent) -> dict[str, Any]:
    """The modules of an agent that carry weights, by name."""
    return {"told": agent.told} if isinstance(agent, TDMPCAgent) else phihp.modules(agent)


def is_tdmpc(content: Mapping[str, Any]) -> bool:
    """Whether an agent's JSON describes one of TD-MPC."""
    return "told" in content
