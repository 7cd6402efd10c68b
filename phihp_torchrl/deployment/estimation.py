"""Who estimates a task's disturbance in a real loop: a model, or the caller."""

from __future__ import annotations

import logging
from typing import Any

from torch import nn

from phihp_torchrl.baselines import Controller
from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.deployment.exported import ExportedAgent
from phihp_torchrl.deployment.observer import VelocityObserver
from phihp_torchrl.tasks import Task

_log = logging.getLogger(__name__)


def find_model(agent: Any) -> nn.Module | None:
    """The model of an agent, or of the baseline that it is or acts by.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.baselines import PID
        >>> task = get_task("pendulum")
        >>> model = HybridDynamics.pure_prior(task)
        >>> pid = PID.from_model(task, model)
        >>> find_model(Agent(task, actor=pid)) is find_model(pid) is model
        True
    """
    found, actor = getattr(agent, "dynamics", None), getattr(agent, "actor", None)
    if found is None and isinstance(actor, Controller):
        found = getattr(actor, "dynamics", None)
    return found


def needs_estimate(agent: Any, task: Task, observer: VelocityObserver | None) -> bool:
    """Whether an agent must be given the estimate of a disturbance that no model makes.

    Agents and exported ones have learned what to do about it. Any other module may ignore it; it
    gets an estimate of 0, unless the observations have one.

    Raises:
        ConfigError: for such an agent with an observer, whose states never have an estimate.
    """
    needs = isinstance(agent, (Agent, ExportedAgent))
    if needs and observer is not None:
        raise ConfigError(
            "dynamics",
            "expected a model, by which the task's disturbance is estimated, got None, and the "
            "agent has none (`load_agent(...).dynamics` is the one that it was made with).",
        )
    _log.warning(
        "dynamics: neither it nor the agent has a model by which the disturbance of task %r is "
        "estimated: an observation of the system alone %s. Give the model "
        "(`load_agent(...).dynamics`), or observations of all %d numbers, with your own estimate.",
        task.name,
        "is refused" if needs else "counts as an estimate of 0",
        task.observation_dim,
    )
    return needs
