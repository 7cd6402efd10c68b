"""The planner of an agent from its configuration."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase

from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.envs import WorldModelEnv
from phihp_torchrl.planners.cem import CEMPlanner
from phihp_torchrl.planners.settings import PlanSettings


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
