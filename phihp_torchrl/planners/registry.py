"""The registered kinds of planners, and the function that makes an agent's planner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from phihp_torchrl.config import ConfigError, Registry, offer, resolve_seconds, to_mapping
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import WorldModelEnv
from phihp_torchrl.planners.cem import CEMConfig
from phihp_torchrl.planners.cem_planner import CEMPlanner
from phihp_torchrl.planners.mppi import MPPIConfig
from phihp_torchrl.planners.mppi_planner import MPPIPlanner
from phihp_torchrl.planners.sampling_planner import SamplingPlanner
from phihp_torchrl.planners.search import SearchConfig


@dataclass(frozen=True)
class PlannerKind:
    """A registered kind of planner.

    Args:
        config: dataclass of its settings, whose attribute ``kind`` is its name.
        build: ``(env, config, actor=, qvalue=, compile=, generator=) -> planner``.
        about: description in one line.
    """

    config: type[SearchConfig]
    build: Callable[..., SamplingPlanner]
    about: str = ""


PLANNERS: Registry[PlannerKind] = Registry("planner")
"""Registered kinds of planners by name; the first is the default."""


def register_planner(
    name: str,
    config: type[SearchConfig],
    build: Callable[..., SamplingPlanner],
    *,
    about: str = "",
    replace: bool = False,
) -> PlannerKind:
    """Register a kind of planner, for ``planner=name`` in settings and for agents on disk.

    Args:
        name: the name, which must equal ``config.kind``.
        config: dataclass of its settings.
        build: ``(env, config, actor=, qvalue=, compile=, generator=) -> planner``.
        about: description in one line.
        replace: whether a planner of that name may be replaced.

    Returns:
        The registered kind.

    Raises:
        ConfigError: if the name is taken and ``replace`` is false, or ``config.kind`` differs from
            it.

    Examples:
        >>> kind = register_planner("cem", CEMConfig, CEMPlanner.from_config, replace=True)
        >>> kind.config.kind
        'cem'
    """
    if getattr(config, "kind", None) != name:
        raise ConfigError(
            "planner", f"expected settings whose kind is {name!r}, got {config.__name__}."
        )
    kind = PLANNERS.register(name, PlannerKind(config, build, about), replace=replace)
    offer("planner", name, {"planner": {"kind": name, **to_mapping(config())}})
    return kind


def make_planner(
    world_model: TaskWorldModel,
    actor: TensorDictModuleBase | None,
    qvalue: TensorDictModuleBase | None,
    config: SearchConfig,
    *,
    compile: bool | dict[str, Any] = False,
    generator: torch.Generator | None = None,
) -> SamplingPlanner:
    """Make the planner that ``config`` describes, in a task's world model.

    Args:
        world_model: the model to plan in; later changes of its parameters take effect at once.
        actor: the policy that guides the planner, or ``None``, which requires
            ``num_policy_candidates`` = 0.
        qvalue: the critics for the value beyond the horizon, or ``None``.
        config: settings of a registered kind of planner.
        compile: whether to compile the plan as one full graph.
        generator: source of the noise. Defaults to torch's global generator.

    Raises:
        ConfigError: for an unknown kind of planner.
        ValueError: for settings that do not fit actor and critics.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> plain_cem = CEMConfig(planning_horizon=30, num_policy_candidates=0, gamma=1.0)
        >>> make_planner(model, None, None, plain_cem).settings.planning_horizon
        30
    """
    # A planner never resets its env. With a seed, torch's global generator is not advanced.
    env = WorldModelEnv(world_model, seed=0)
    config = resolve_seconds(config, world_model.task.time_step)
    build = PLANNERS.find(config.kind).build
    return build(env, config, actor=actor, qvalue=qvalue, compile=compile, generator=generator)


register_planner(
    CEMConfig.kind,
    CEMConfig,
    CEMPlanner.from_config,
    about="the cross-entropy method with the policy as a prior",
)
register_planner(
    MPPIConfig.kind,
    MPPIConfig,
    MPPIPlanner.from_config,
    about="model-predictive path integral control with the policy as a prior",
)
