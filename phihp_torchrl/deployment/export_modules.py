"""An agent's plan and its actor as modules of tensors, which can be exported."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from phihp_torchrl.baselines import Catch
from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.planners import CEMPlanner, cem_plan, colored
from phihp_torchrl.tasks import Task

_logger = logging.getLogger(__name__)


PLAN, LAST = "plan", "last"
"""The names of what a plan keeps: the plan to go on from, and the action that was sent last."""


class ExportModule(nn.Module):
    """The base of what is exported: one observation ``[o]`` to one action ``[m]``.

    Args:
        task: the task of the agent.
        noise_shape: shape of the standard normal noise that is a second input, or ``None``.
        memory: further inputs that are kept from step to step, by name, with their values where an
            episode starts.
    """

    part: str
    """The name of this part of an agent: ``"plan"`` or ``"actor"``."""

    def __init__(
        self,
        task: Task,
        noise_shape: tuple[int, ...] | None,
        memory: Mapping[str, Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.task, self.noise_shape, self.memory = task, noise_shape, dict(memory or {})
        self.in_loop = False
        """Whether the steps of a long plan are a loop of the graph, which compiles sooner."""
        self._observation = task.observe(task.sample_start([]))

    @property
    def input_names(self) -> list[str]:
        """The names of the inputs, in order."""
        noise = [] if self.noise_shape is None else ["noise"]
        return ["observation", *noise, *self.memory]

    @property
    def output_names(self) -> list[str]:
        """The names of the outputs, in order."""
        return ["action", *([f"next_{PLAN}"] if PLAN in self.memory else [])]

    def draw(self) -> tuple[Tensor, ...]:
        """Return what goes with an observation where an episode starts: noise, and the memory."""
        noise = () if self.noise_shape is None else (torch.randn(self.noise_shape),)
        return (*noise, *self.memory.values())

    def example(self) -> tuple[Tensor, ...]:
        """Return an observation, and what goes with it, of the right shapes."""
        return (self._observation, *self.draw())


def action_of(found: Tensor | Sequence[Tensor]) -> Tensor:
    """The action among the outputs of what is exported."""
    return found if isinstance(found, Tensor) else found[0]


class PlanModule(ExportModule):
    """One plan of an agent as a module of tensors, for export: observation and noise to action.

    It reads an observation ``[o]`` and standard normal noise of shape ``noise_shape``, and returns
    an action ``[m]``. It draws no random numbers and keeps nothing itself: what the planner keeps
    from step to step is a further input, as far as its settings need it (:attr:`memory`). With
    ``warm_start`` that is ``plan`` ``[H, m]``, for which the module returns the next one beside the
    action; with ``change_cost`` or ``keep_incumbent`` it is ``last`` ``[m]``, the action that was
    sent last, NaN where there is none. It plans at every step, and a warning says so where
    ``replan_every`` is another. Near the goal the action is the regulator's, if the agent has one.

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
        if settings.replan_every != 1:
            _logger.warning(
                "A plan that is exported is sought at every step: replan_every = %s has no effect "
                "in it. save_agent(agent, path, packaged=True) keeps it.",
                settings.replan_every,
            )
        shape = settings.noise_shape((), agent.task.action_dim)
        center, memory = planner.bounds.center, {}
        if settings.warm_start:
            memory[PLAN] = center.repeat(settings.planning_horizon, 1)
        if settings.change_cost or settings.keep_incumbent:
            memory[LAST] = torch.full_like(center, torch.nan)
        super().__init__(agent.task, shape, memory)
        self.planner = planner  # whose parameters are then this module's
        self.catch = agent.catch if isinstance(agent.catch, Catch) else None
        if agent.catch is not self.catch:
            _logger.warning(
                "The regulator that acts where the reference stands still has a memory, and is "
                "left out of a plan that is exported: it plans there too."
            )
        # The first call keeps the filter of this shape, which an export then takes as a constant.
        colored(torch.zeros(shape), planner.settings.noise_beta, dim=1)

    def forward(
        self, observation: Tensor, noise: Tensor, *memory: Tensor
    ) -> Tensor | tuple[Tensor, Tensor]:
        """Return the first action of a plan, ``[m]``, and what of it the next plan starts from."""
        planner, kept = self.planner, dict(zip(self.memory, memory, strict=True))
        found = cem_plan(
            observation,
            colored(noise, planner.settings.noise_beta, dim=1),
            kept.get(PLAN),
            kept.get(LAST),
            problem=planner.problem(compiled=self.in_loop),
            settings=planner.settings,
        )
        action = found.actions[0]
        if self.catch is not None:
            action = self.catch(self.task.locate(observation), action)
        if PLAN not in kept:
            return action
        return action, torch.cat([found.actions[1:], self.memory[PLAN][-1:]])


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
        return self.network(observation[None])[0]  # Inductor cannot fuse a layer without a batch
