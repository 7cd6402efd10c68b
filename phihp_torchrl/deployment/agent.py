"""A trained agent whole: model, actor, critics and planner behind one call."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor

from phihp_torchrl.agents.networks import Actor, TwinQ
from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.planners.factory import PlannerConfig, make_planner
from phihp_torchrl.tasks import Task


class Agent(TensorDictModuleBase):
    """Observation in, action out: PhIHP's third phase (paper, section 4.3), or its actor alone.

    It reads ``"observation"`` ``[*batch, o]`` and writes ``"action"`` ``[*batch, m]`` in physical
    units. The parts are attributes and may be ``None``; they are shared, not copied, so an agent
    made during training follows it.

    Args:
        task: what it was trained for.
        dynamics: the learned transition, which the planner needs.
        actor: the policy.
        qvalue: the critics, for beyond the planner's horizon.
        planner_config: the planner's settings; ``None`` for an agent without one.
        use_planner: whether to plan; ``False`` is the actor alone. See also :meth:`actor_alone`.
        compile: whether to compile the plan (10 to 40 s at first, from the cache afterwards).
        metadata: what to know about it (seed, commit, returns …), for people; JSON.

    Raises:
        ValueError: if the parts do not suffice to act; when called, for an observation that is
            missing, not finite, or of the wrong shape, dtype or device.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> task = get_task("pendulum")
        >>> agent = Agent(
        ...     task,
        ...     dynamics=HybridDynamics.hybrid(task),
        ...     actor=Actor(task),
        ...     qvalue=TwinQ(task),
        ...     planner_config=PlannerConfig(),
        ... )
        >>> observation = task.system.observe(task.reset.sample([4]))
        >>> agent(TensorDict(observation=observation, batch_size=[4]))["action"].shape
        torch.Size([4, 1])
    """

    def __init__(
        self,
        task: Task,
        *,
        dynamics: HybridDynamics | None = None,
        actor: Actor | TensorDictModuleBase | None = None,
        qvalue: TwinQ | TensorDictModuleBase | None = None,
        planner_config: PlannerConfig | None = None,
        use_planner: bool = True,
        compile: bool | dict[str, Any] = False,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.in_keys = ["observation"]
        self.out_keys = ["action"]
        if isinstance(actor, Actor):
            actor = TensorDictModule(actor, ["observation"], ["action"])
        if isinstance(qvalue, TwinQ):
            qvalue = TensorDictModule(qvalue, ["observation", "action"], ["state_action_value"])
        self.task = task
        self.dynamics = dynamics
        self.actor = actor
        self.qvalue = qvalue
        self.planner_config = planner_config
        self.metadata = dict(metadata or {})
        self.planner = None
        if use_planner and planner_config is not None:
            if dynamics is None:
                raise ValueError("dynamics: expected a model for the planner, got None.")
            world_model = TaskWorldModel(task, dynamics)
            self.planner = make_planner(world_model, actor, qvalue, planner_config, compile=compile)
        elif actor is None:
            raise ValueError("actor: expected one for an agent that does not plan, got None.")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"`` ``[*batch, m]`` for ``"observation"`` ``[*batch, o]``; no gradients.

        Where the planner replans every few steps or starts warm, ``"is_init"`` tells it that an
        episode starts (:class:`torchrl.envs.InitTracker`); without it, call :meth:`reset`.
        """
        with torch.no_grad():
            if self.planner is not None:
                return self.planner(tensordict)
            self._check(tensordict.get("observation", None), tensordict.batch_size)
            return self.actor(tensordict)  # type: ignore[misc]  # one of the two is there

    def reset(self) -> None:
        """Forget the previous plan: a new episode starts."""
        if self.planner is not None:
            self.planner.reset()

    def actor_alone(self) -> Agent:
        """The same agent without planning, on the same modules."""
        return Agent(
            self.task,
            dynamics=self.dynamics,
            actor=self.actor,
            qvalue=self.qvalue,
            planner_config=self.planner_config,
            use_planner=False,
            metadata=self.metadata,
        )

    def _check(self, observation: Tensor | None, batch: torch.Size) -> None:
        shape = [*batch, self.task.system.observation_dim]
        if observation is None:
            raise ValueError(f"observation: expected a tensor of shape {shape}, got none.")
        parameter = next(self.actor.parameters(), observation)  # type: ignore[union-attr]
        expected = (torch.Size(shape), parameter.dtype, parameter.device)
        if (observation.shape, observation.dtype, observation.device) != expected:
            raise ValueError(
                f"observation: expected {parameter.dtype} of shape {shape} on {parameter.device}, "
                f"got {observation.dtype} of shape {list(observation.shape)} "
                f"on {observation.device}."
            )
        if observation.device.type == "cpu" and not observation.isfinite().all():
            raise ValueError("observation: expected finite observations, got some that are not.")
