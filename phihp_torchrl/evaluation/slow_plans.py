"""Whether an agent's plans are made within its task's time step, and what is faster."""

from __future__ import annotations

import logging

from phihp_torchrl.deployment import Agent
from phihp_torchrl.planners import FAST_LIMITS, CEMConfig

_log = logging.getLogger(__name__)


def warn_of_slow_plans(agent: Agent, milliseconds: float) -> None:
    """Say so where an agent that acts by its plans takes longer for one than a time step.

    Args:
        agent: the agent. One whose calibration lets the actor act makes no plan.
        milliseconds: the median time of an action.
    """
    step = 1e3 * agent.task.time_step
    by_plans = agent.planner is not None and agent.metadata.get("acting") != "actor"
    if not by_plans or milliseconds <= step:
        return
    faster = [*_smaller(agent), *_native(agent)]
    if agent.actor is not None:
        faster.append("the actor alone (load_agent(..., planner=False))")
    _log.warning(
        "A plan takes %.3g ms, and the time step is %.3g ms: choose %s.",
        milliseconds,
        step,
        ", or ".join(faster or ["a longer time step"]),
    )


def _smaller(agent: Agent) -> list[str]:
    """The fast budget, for plans that it makes smaller."""
    config = agent.planner_config
    if type(agent) is not Agent or not isinstance(config, CEMConfig):  # it changes no others
        return []
    longer = config.planning_horizon > FAST_LIMITS["planning_horizon"]
    most = FAST_LIMITS["num_candidates"] * FAST_LIMITS["optim_steps"]
    larger = longer or config.num_candidates * config.optim_steps > most
    return ["a smaller plan (phihp train ... budget=fast)"] if larger else []


def _native(agent: Agent) -> list[str]:
    """Native code, for plans that can be and are not compiled."""
    planner = agent.planner
    assert planner is not None
    if planner.compiles or planner.why_not_compiled():
        return []
    # One without weights has no example, and no package.
    if any(True for _ in agent.parameters()) and planner.plans_ahead(agent.example()):
        return []
    return [
        "a plan that is compiled (load_agent(..., compile=True)) or packaged "
        "(evaluate.packaged=true, or save_agent(..., packaged=True))"
    ]
