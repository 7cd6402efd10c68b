"""When a run packages the plan of its agent, so that the agent plans by native code once loaded."""

from __future__ import annotations

import os

from phihp_torchrl.deployment import Agent
from phihp_torchrl.trainers.context import Context

# Seconds of training that earn a package, which takes another core half a minute.
_EARNS = 60.0


def earns_package(context: Context, agent: Agent) -> bool:
    """Whether the plan of an agent is packaged: as the settings say, or where it costs nobody much.

    That is on the CPU after a minute of training, where the plan is not compiled anyway and a core
    is to spare. Unlike what is compiled in a run, no result depends on it.

    Args:
        context: the arguments of the last phase.
        agent: the agent that it evaluates and saves.
    """
    asked = context.settings.packaged
    if agent.planner is None or asked != "auto":
        return agent.planner is not None and asked
    seconds = sum(context.directory.read_metadata().get("seconds", {}).values())
    on_cpu = next(agent.parameters()).device.type == "cpu"
    return (
        on_cpu and seconds >= _EARNS and not context.compile and _cores() > context.config.threads
    )


def _cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
