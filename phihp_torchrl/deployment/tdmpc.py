"""A trained TD-MPC agent: encoder, latent model, policy, critics and planner behind one call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from phihp_torchrl.agents.tdmpc.told import TOLD, TOLDConfig
from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.deployment.blueprint import TaskSignature, check_sizes
from phihp_torchrl.planners.factory import make_latent_planner
from phihp_torchrl.planners.settings import MPPISettings
from phihp_torchrl.tasks import Task


class TDMPCAgent(Agent):
    """Observation in, action out: TD-MPC's planner, or its policy alone.

    It is used, saved and loaded as every :class:`~phihp_torchrl.deployment.Agent`. The networks are
    shared, not copied, so an agent made during training follows it.

    Args:
        task: what it was trained for.
        told: the networks.
        planner_config: the planner's settings; ``None`` for the policy alone.
        use_planner: whether to plan.
        compile: whether to compile the plan.
        metadata: what to know about it, for people; JSON.

    Raises:
        ValueError: when called, for an observation that is missing, not finite, or of the wrong
            shape, dtype or device.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> task = get_task("pendulum")
        >>> agent = TDMPCAgent(task, TOLD.for_task(task), MPPISettings(num_candidates=100))
        >>> observation = task.system.observe(task.reset.sample([4]))
        >>> agent(TensorDict(observation=observation, batch_size=[4]))["action"].shape
        torch.Size([4, 1])
    """

    def __init__(
        self,
        task: Task,
        told: TOLD,
        planner_config: MPPISettings | None = None,
        *,
        use_planner: bool = True,
        compile: bool | dict[str, Any] = False,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        actor = TensorDictModule(_Policy(told), ["observation"], ["action"])
        super().__init__(task, actor=actor, metadata=metadata)
        self.told = told
        self.settings = planner_config
        if use_planner and planner_config is not None:
            self.encoder = TensorDictModule(told.encoder, ["observation"], ["latent"])
            self.planner = make_latent_planner(told, planner_config, compile=compile)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"`` ``[*batch, m]`` for ``"observation"`` ``[*batch, o]``; no gradients.

        ``"is_init"`` tells that an episode starts (:class:`torchrl.envs.InitTracker`); without it,
        call :meth:`reset`.
        """
        if self.planner is None:
            return super().forward(tensordict)
        with torch.no_grad():
            self._check(tensordict.get("observation", None), tensordict.batch_size)
            latent = self.encoder(tensordict.select("observation", "is_init", strict=False))
            return tensordict.set("action", self.planner(latent)["action"])

    def actor_alone(self) -> TDMPCAgent:
        """The policy without planning, on the same networks."""
        return TDMPCAgent(
            self.task, self.told, self.settings, use_planner=False, metadata=self.metadata
        )


class _Policy(torch.nn.Module):
    """The policy of observations."""

    def __init__(self, told: TOLD) -> None:
        super().__init__()
        self.told = told

    def forward(self, observation: Tensor) -> Tensor:
        return self.told.policy(self.told.encode(observation))


@dataclass(frozen=True)
class TDMPCBlueprint:
    """What a :class:`TDMPCAgent` is made of.

    Args:
        task: the task's signature.
        told: sizes of the networks.
        planner: the planner's settings.
    """

    task: TaskSignature
    told: TOLDConfig
    planner: MPPISettings | None

    def __post_init__(self) -> None:
        check_sizes("told", tuple(vars(self.told).values()))

    @classmethod
    def of(cls, agent: TDMPCAgent) -> TDMPCBlueprint:
        """The blueprint of an agent."""
        return cls(TaskSignature.of(agent.task), agent.told.config, agent.settings)

    def build_modules(self, task: Task) -> dict[str, Any]:
        """New networks, untrained."""
        return {"told": TOLD.for_task(task, self.told)}

    def assemble(self, task: Task, parts: Mapping[str, Any], **options: Any) -> TDMPCAgent:
        """The agent of these parts; ``options`` go to :class:`TDMPCAgent`."""
        return TDMPCAgent(task, parts["told"], self.planner, **options)
