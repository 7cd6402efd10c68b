"""The planner of TD-MPC: MPPI in the latent model, with a horizon that grows during training."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from tensordict.nn import TensorDictModule

from phihp_torchrl.config import ConfigError, Steps, check_count, check_steps, in_seconds
from phihp_torchrl.planners import MPPIConfig, MPPIPlanner
from phihp_torchrl.tdmpc.latent_env import LatentEnv
from phihp_torchrl.tdmpc.networks import TOLD


@dataclass(frozen=True)
class ScheduledMPPIConfig(MPPIConfig):
    """Settings of an :class:`~phihp_torchrl.MPPIPlanner` that change during training.

    Over the first real steps the horizon runs linearly from ``initial_horizon`` to
    ``planning_horizon`` (rounded down), and the floor of the std from ``initial_min_std`` to
    ``min_std``.

    Args:
        initial_horizon: initial planning horizon, in steps or as a duration.
        initial_min_std: initial lower limit of the std, in units of the action's half-range.
        schedule_steps: real steps in which horizon and limit reach their final values; 0 for the
            final values from the start.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> now = ScheduledMPPIConfig().at(12_500)
        >>> now.planning_horizon, round(now.min_std, 3)
        (3, 0.275)
    """

    initial_horizon: Steps = 1
    initial_min_std: float = 0.5
    schedule_steps: int = 25_000

    def __post_init__(self) -> None:
        super().__post_init__()
        check_steps(self, "initial_horizon")
        if not in_seconds(self.initial_horizon):
            check_count(self, "initial_horizon", most="planning_horizon")
        check_count(self, "schedule_steps", least=0)
        if not self.min_std <= self.initial_min_std <= self.init_std:
            raise ConfigError(
                "initial_min_std",
                f"expected min_std = {self.min_std} to init_std = {self.init_std}, "
                f"got {self.initial_min_std}.",
            )

    def at(self, real_steps: int) -> MPPIConfig:
        """The settings after so many real steps."""
        done = min(1.0, real_steps / self.schedule_steps) if self.schedule_steps else 1.0
        horizon = self.initial_horizon + done * (self.planning_horizon - self.initial_horizon)
        own = {f.name: getattr(self, f.name) for f in fields(MPPIConfig)}
        own["planning_horizon"] = int(horizon)
        own["min_std"] = (1.0 - done) * self.initial_min_std + done * self.min_std
        return MPPIConfig(**own)


def make_latent_planner(
    told: TOLD,
    settings: MPPIConfig,
    *,
    compile: bool | dict[str, Any] = False,
    generator: torch.Generator | None = None,
) -> MPPIPlanner:
    """The planner that plans among the latents of ``told``, ``"latent"`` -> ``"action"``.

    Args:
        told: model, policy and critics; later changes of its parameters are seen at once.
        settings: the numbers.
        compile: whether to compile the plan, a graph for each horizon.
        generator: source of the noise. Defaults to torch's global one.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl.tasks import ActionBounds
        >>> told = TOLD(3, ActionBounds.from_limits([-2.0], [2.0]))
        >>> planner = make_latent_planner(told, MPPIConfig(num_candidates=100))
        >>> planner(TensorDict(latent=torch.zeros(4, 50), batch_size=[4]))["action"].shape
        torch.Size([4, 1])
    """
    latent_dim, bounds = told.config.latent_dim, told.bounds
    env = LatentEnv(
        told,
        latent_dim,
        bounds,
        start=lambda batch: torch.zeros(*batch, latent_dim, device=bounds.low.device),
    )
    return MPPIPlanner(
        env,
        settings,
        actor=TensorDictModule(told.policy, ["latent"], ["action"]),
        qvalue=TensorDictModule(told.twin_values, ["latent", "action"], ["state_action_value"]),
        compile=compile,
        generator=generator,
    )
