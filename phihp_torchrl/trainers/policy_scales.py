"""The units in which the policy phase trains its networks: measured once, checked on resuming."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import torch

from phihp_torchrl.agents import Scales, measure_scales, visited_states
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import StartStates
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.policy_config import PolicyConfig

_log = logging.getLogger(__name__)


def training_scales(
    model: TaskWorldModel, start_states: StartStates, config: PolicyConfig, seed: int
) -> Scales:
    """The units to train in; they have a generator of their own, which moves nothing else.

    Args:
        model: the model, in physical units.
        start_states: where imagined episodes start.
        config: settings of the phase.
        seed: seed of that generator.
    """
    task = model.task
    if config.scales == "none":
        return _physical(task)
    max_age = config.max_age or task.max_steps
    generator = torch.Generator().manual_seed(seed)
    states = visited_states(model, start_states, min(max_age, 200), generator)
    gamma = config.td3.gamma
    horizon = max_age if gamma == 1 else min(max_age, 1 / (1 - gamma))
    scales = measure_scales(model, states, horizon, generator)
    if not scales.are_one:
        _log.info(
            "Networks read (observation - %s) / %s and learn rewards / %g.",
            scales.center.tolist(),
            scales.scale.tolist(),
            scales.reward,
        )
    return scales


def check_scales(task: Task, ours: Scales, saved: Mapping[str, Any] | None) -> None:
    """Refuse to go on with networks that were trained in other units than ``ours``.

    Args:
        task: the task.
        ours: the units measured here.
        saved: the fields of those of the checkpoint; none for physical units.

    Raises:
        ConfigError: if they differ.
    """
    there = Scales(**saved) if saved else _physical(task)
    same = all(
        torch.equal(torch.as_tensor(getattr(there, name)), torch.as_tensor(value))
        for name, value in vars(ours).items()
    )
    if not same:
        raise ConfigError(
            "policy.scales",
            f"expected networks trained in the units measured here, {ours}, got some "
            f"trained in {there}; start phase 'policy' again, with policy.scales=none for "
            "physical units.",
        )


def _physical(task: Task) -> Scales:
    size = task.observation_dim
    return Scales(torch.zeros(size), torch.ones(size))
