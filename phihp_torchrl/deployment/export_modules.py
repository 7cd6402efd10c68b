"""An agent's plan and its actor as modules of tensors, which can be exported."""

from __future__ import annotations

import logging

import torch
from torch import Tensor, nn

from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.planners import CEMPlanner, cem_plan, colored
from phihp_torchrl.tasks import Task

_logger = logging.getLogger(__name__)


class ExportModule(nn.Module):
    """The base of what is exported: one observation ``[o]`` to one action ``[m]``.

    Args:
        task: the task of the agent.
        noise_shape: shape of the standard normal noise that is a second input, or ``None``.
    """

    part: str
    """The name of this part of an agent: ``"plan"`` or ``"actor"``."""

    def __init__(self, task: Task, noise_shape: tuple[int, ...] | None) -> None:
        super().__init__()
        self.task, self.noise_shape = task, noise_shape
        self._observation = task.observe(task.sample_start([]))

    @property
    def input_names(self) -> list[str]:
        """The names of the inputs, in order."""
        return ["observation"] if self.noise_shape is None else ["observation", "noise"]

    def draw(self) -> tuple[Tensor, ...]:
        """Return what goes with an observation: noise, if there is some."""
        return () if self.noise_shape is None else (torch.randn(self.noise_shape),)

    def example(self) -> tuple[Tensor, ...]:
        """Return an observation, and noise if there is some, of the right shapes."""
        return (self._observation, *self.draw())


class PlanModule(ExportModule):
    """One plan of an agent as a module of tensors, for export: observation and noise to action.

    It reads an observation ``[o]`` and standard normal noise of shape ``noise_shape``, and returns
    an action ``[m]``. It draws no random numbers and keeps no plan between steps, so it plans at
    every step, regardless of ``replan_every``, ``warm_start`` and ``keep_incumbent``, and the first
    action of a plan has no ``change_cost``. A warning says which of these the agent has.

    Args:
        agent: an agent that plans by a :class:`~phihp_torchrl.CEMPlanner`.

    Raises:
        ConfigError: for an agent without such a planner, or whose model does not compile.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import Actor, TwinQ
        >>> from phihp_torchrl.planners import CEMConfig
        >>> task = get_task("pendulum")
        >>> parts = {"actor": Actor(task), "qvalue": TwinQ(task), "planner_config": CEMConfig()}
        >>> module = PlanModule(Agent(task, dynamics=HybridDynamics.hybrid(task), **parts))
        >>> module(torch.tensor([1.0, 0.0, 0.0]), torch.randn(module.noise_shape)).shape
        torch.Size([1])
    """

    part = "plan"

    def __init__(self, agent: Agent) -> None:
        planner = agent.planner
        if planner is None:
            raise ConfigError("agent", "expected one with a planner, got one that acts without.")
        if not isinstance(planner, CEMPlanner):
            raise ConfigError(
                "agent",
                f"expected one that plans with a CEMPlanner, got a {type(planner).__name__}: it "
                "starts each plan from the one before, and a plan by itself is not what it does.",
            )
        if not getattr(planner.env.tensor_model, "compiles", True):
            raise ConfigError("agent", "expected a model whose integrator compiles, got another.")
        settings = planner.settings
        lost = [name for name in ("warm_start", "keep_incumbent", "change_cost")
                if getattr(settings, name)]  # fmt: skip
        lost += ["replan_every"] if settings.replan_every != 1 else []
        if lost:
            _logger.warning(
                "A plan that is exported keeps nothing from one step to the next, so it may change "
                "its action more than the agent does: %s of the planner has no effect in it. "
                "save_agent(agent, path, packaged=True) keeps all.",
                " and ".join(lost),
            )
        shape = settings.noise_shape((), agent.task.action_dim)
        super().__init__(agent.task, shape)
        self.planner = planner  # whose parameters are then this module's
        # The first call keeps the filter of this shape, which an export then takes as a constant.
        colored(torch.zeros(shape), planner.settings.noise_beta, dim=1)

    def forward(self, observation: Tensor, noise: Tensor) -> Tensor:
        """Return the first action of a plan, ``[m]``."""
        planner = self.planner
        noise = colored(noise, planner.settings.noise_beta, dim=1)
        found = cem_plan(observation, noise, problem=planner.problem(), settings=planner.settings)
        return found.actions[0]


class ActorModule(ExportModule):
    """The actor of an agent as a module of tensors, for export: observation ``[o]`` to ``[m]``.

    Args:
        agent: an agent with an actor that is a network of the observation alone.

    Raises:
        ConfigError: for an agent without such an actor.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.agents import Actor
        >>> task = get_task("pendulum")
        >>> module = ActorModule(Agent(task, actor=Actor(task)))
        >>> module(*module.example()).shape, module.input_names
        (torch.Size([1]), ['observation'])
    """

    part = "actor"

    def __init__(self, agent: Agent) -> None:
        network = getattr(agent.actor, "module", None)
        if network is None or list(getattr(agent.actor, "in_keys", ())) != ["observation"]:
            raise ConfigError(
                "agent", "expected one with an actor that reads the observation alone."
            )
        super().__init__(agent.task, None)
        self.network = network

    def forward(self, observation: Tensor) -> Tensor:
        """Return the actor's action, ``[m]``."""
        return self.network(observation)
