"""The planner of an agent from its configuration."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from phihp_torchrl.agents.tdmpc.told import TOLD
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.envs import LatentEnv, WorldModelEnv
from phihp_torchrl.planners.cem import CEMPlanner
from phihp_torchrl.planners.mppi import MPPIPlanner
from phihp_torchrl.planners.settings import MPPISettings, PlanSettings
from phihp_torchrl.ranges import check_not_negative


@dataclass(frozen=True)
class PlannerConfig(PlanSettings):
    """Everything about a :class:`~phihp_torchrl.CEMPlanner` that is a number or a name.

    The names are the planner's arguments, which it documents; the defaults are the published
    settings (SPEC section 4) but for ``compare_with_actor``.

    Args:
        replan_every: steps of one plan to act before the next, ``RH``.
        warm_start: start from the previous plan, shifted, where an episode goes on.

    Raises:
        ValueError: for a value out of range, by the name of its argument.
    """

    planning_horizon: int = 5
    optim_steps: int = 3
    num_candidates: int = 220
    top_k: int = 10
    num_policy_candidates: int = 20
    replan_every: int = 1
    warm_start: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        every = self.replan_every
        if isinstance(every, bool) or not isinstance(every, int):
            raise ValueError(f"replan_every: expected an integer, got {every!r}.")
        if not 1 <= every <= self.planning_horizon:
            raise ValueError(
                f"replan_every: expected 1 to planning_horizon={self.planning_horizon}, "
                f"got {every}."
            )
        for name in ("warm_start", "compare_with_actor"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name}: expected true or false, got {getattr(self, name)!r}.")


def make_planner(
    world_model: TaskWorldModel,
    actor: TensorDictModuleBase | None,
    qvalue: TensorDictModuleBase | None,
    config: PlannerConfig,
    *,
    compile: bool | dict[str, Any] = False,
    generator: torch.Generator | None = None,
) -> CEMPlanner:
    """The planner that ``config`` describes, on a task's world model.

    Args:
        world_model: the model to plan in; later changes of its parameters are seen at once.
        actor: the policy prior, or ``None`` for plain CEM (``num_policy_candidates`` is then 0).
        qvalue: the critics for beyond the horizon, or ``None``.
        config: the numbers.
        compile: whether to compile the plan as one full graph.
        generator: source of the noise. Defaults to torch's global one.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.oracle(task))
        >>> plain_cem = PlannerConfig(planning_horizon=30, num_policy_candidates=0, gamma=1.0)
        >>> make_planner(model, None, None, plain_cem).settings.planning_horizon
        30
    """
    # A planner never resets its env: the fixed seed keeps torch's global generator untouched.
    env = WorldModelEnv(world_model, seed=0)
    return CEMPlanner(
        env, actor=actor, qvalue=qvalue, compile=compile, generator=generator, **asdict(config)
    )


@dataclass(frozen=True)
class MPPIConfig(MPPISettings):
    """An :class:`~phihp_torchrl.planners.MPPIPlanner` whose horizon and floor of the std change.

    Both run linearly over the first real steps, the horizon from ``initial_horizon`` to
    ``planning_horizon`` (rounded down) and the floor from ``initial_min_std`` to ``min_std``. The
    defaults are the published ones.

    Args:
        initial_horizon: horizon at first.
        initial_min_std: floor of the std at first, in units of the action's half-range.
        schedule_steps: real steps until both have arrived; 0 for at once.

    Raises:
        ValueError: for a value out of range, by the name of its argument.

    Examples:
        >>> now = MPPIConfig().at(12_500)
        >>> now.planning_horizon, round(now.min_std, 3)
        (3, 0.275)
    """

    initial_horizon: int = 1
    initial_min_std: float = 0.5
    schedule_steps: int = 25_000

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.initial_horizon <= self.planning_horizon:
            raise ValueError(
                f"initial_horizon: expected 1 to planning_horizon={self.planning_horizon}, "
                f"got {self.initial_horizon}."
            )
        if not self.min_std <= self.initial_min_std <= self.init_std:
            raise ValueError(
                f"initial_min_std: expected min_std={self.min_std} to init_std={self.init_std}, "
                f"got {self.initial_min_std}."
            )
        check_not_negative(self, "schedule_steps")

    def at(self, real_steps: int) -> MPPISettings:
        """The settings after so many real steps."""
        done = min(1.0, real_steps / self.schedule_steps) if self.schedule_steps else 1.0
        horizon = self.initial_horizon + done * (self.planning_horizon - self.initial_horizon)
        own = {f.name: getattr(self, f.name) for f in fields(MPPISettings)}
        own["planning_horizon"] = int(horizon)
        own["min_std"] = (1.0 - done) * self.initial_min_std + done * self.min_std
        return MPPISettings(**own)


def make_latent_planner(
    told: TOLD,
    settings: MPPISettings,
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
        >>> planner = make_latent_planner(TOLD(3, [2.0]), MPPIConfig(num_candidates=100).at(0))
        >>> planner(TensorDict(latent=torch.zeros(4, 50), batch_size=[4]))["action"].shape
        torch.Size([4, 1])
    """
    latent_dim, high = told.config.latent_dim, told.action_high
    env = LatentEnv(
        told,
        latent_dim,
        high,
        start=lambda batch: torch.zeros(*batch, latent_dim, device=high.device),
    )
    return MPPIPlanner(
        env,
        settings,
        actor=TensorDictModule(told.policy, ["latent"], ["action"]),
        qvalue=TensorDictModule(told.twin_values, ["latent", "action"], ["state_action_value"]),
        compile=compile,
        generator=generator,
    )
