"""A trained TD-MPC agent: encoder, latent model, policy, critics and planner behind one call."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from phihp_torchrl.config import from_mapping, kind_mapping, read_kind, to_mapping
from phihp_torchrl.deployment import Agent, register_agent
from phihp_torchrl.planners import PLANNERS, MPPIConfig, SearchConfig
from phihp_torchrl.tasks import Task
from phihp_torchrl.tdmpc.networks import TOLD, TOLDConfig
from phihp_torchrl.tdmpc.planner import make_latent_planner


class TDMPCAgent(Agent):
    """A trained TD-MPC agent, which acts by planning in its latent model or by its policy.

    It is saved, loaded and evaluated like every :class:`~phihp_torchrl.Agent`. The networks are
    shared and not copied, so an agent that is made during training changes with it.

    Args:
        task: the task that it was trained for.
        told: the networks.
        planner_config: settings of the planner; ``None`` for the policy alone.
        use_planner: whether to plan.
        compile: whether to compile the plan.
        metadata: further information for people, as JSON values.

    Raises:
        ValueError: when called, for an observation that is missing, not finite, or of the wrong
            shape, dtype or device.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> task = get_task("pendulum")
        >>> agent = TDMPCAgent(task, TOLD.for_task(task), MPPIConfig(num_candidates=100))
        >>> observation = task.observe(task.reset.sample([4]))
        >>> agent(TensorDict(observation=observation, batch_size=[4]))["action"].shape
        torch.Size([4, 1])
    """

    kind = "td-mpc"

    def __init__(
        self,
        task: Task,
        told: TOLD,
        planner_config: MPPIConfig | None = None,
        *,
        use_planner: bool = True,
        compile: bool | dict[str, Any] = False,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(
            task,
            actor=TensorDictModule(_Policy(told), ["observation"], ["action"]),
            metadata=metadata,
        )
        self.told = told
        self.encoder = TensorDictModule(told.encoder, ["observation"], ["latent"])
        self.planner_config = planner_config
        if use_planner and planner_config is not None:
            self.planner = make_latent_planner(told, planner_config, compile=compile)

    def _plan(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self.planner is not None
        self._check(tensordict.get("observation", None), tensordict.batch_size)
        return tensordict.set("action", self.planner(self._planner_input(tensordict))["action"])

    def _planner_input(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.encoder(tensordict.select("observation", "is_init", strict=False))

    def with_planner(self, config: SearchConfig | None, **options: Any) -> TDMPCAgent:
        """An agent on the same networks that plans by other numbers, or not at all."""
        return TDMPCAgent(
            self.task,
            self.told,
            config or self.planner_config,  # type: ignore[arg-type]
            use_planner=config is not None,
            metadata=self.metadata,
            **options,
        )

    def modules_by_name(self) -> dict[str, nn.Module]:
        """The networks."""
        return {"told": self.told}

    @property
    def config(self) -> dict[str, Any]:
        """Sizes of the networks and the planner's numbers."""
        planner = self.planner_config
        return {
            "networks": to_mapping(self.told.config),
            "planner": None if planner is None else kind_mapping(planner),
        }

    @classmethod
    def build_modules(cls, task: Task, config: Mapping[str, Any]) -> dict[str, Any]:
        """The networks that :attr:`config` describes, untrained."""
        sizes = from_mapping(TOLDConfig, config["networks"], "networks")
        return {"told": TOLD.for_task(task, sizes)}

    @classmethod
    def from_config(
        cls, task: Task, config: Mapping[str, Any], modules: Mapping[str, Any], **options: Any
    ) -> TDMPCAgent:
        """The agent that :attr:`config` describes, made of these networks."""
        planner = config.get("planner")
        if planner is not None:
            planner = read_kind(PLANNERS, planner, "planner")
        return cls(task, modules["told"], planner, **options)


class _Policy(nn.Module):
    """The policy of observations."""

    def __init__(self, told: TOLD) -> None:
        super().__init__()
        self.told = told

    def forward(self, observation: Tensor) -> Tensor:
        return self.told.policy(self.told.encode(observation))


register_agent(TDMPCAgent)
