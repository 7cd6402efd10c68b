"""Plans that act in some of the imagined worlds, and meet rewards that the actor does not find."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.agents import Layers, Networks, act, prepare
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.planners import CEMConfig, Problem, cem_plan
from phihp_torchrl.tasks import ActionBounds

SEARCH = CEMConfig(num_candidates=32, num_policy_candidates=8, top_k=4)
"""The search of these plans, with fewer candidates than an agent's; it has the critics' γ."""
_PLANS_FALL, PLANS_END = 0.25, 0.5
"""Shares of the updates from which on plans give way to the actor, and after which none act."""


def planned_share(done: float) -> float:
    """The share of plans that is left after so much of the updates.

    Plans find rewards early, and the actor's last gains are in what it meets itself.

    Examples:
        >>> [planned_share(done) for done in (0.1, 0.25, 0.375, 0.5, 0.9)]
        [1.0, 1.0, 0.5, 0.0, 0.0]
    """
    return min(1.0, max(0.0, (PLANS_END - done) / (PLANS_END - _PLANS_FALL)))


class PlannedActs:
    """A policy of imagined worlds: plans act in the first of them, and the actor in the others.

    The plans are sought as the agent's are, with the networks as they are. They look ahead in the
    model where the actor can only repeat what it has learned. What they meet goes into the replay
    like all else, and TD3 learns from it, whoever acted (guided policy search, Levine and Koltun,
    2013, has its demonstrations from a planner in the same way).

    Args:
        world_model: the model by which to plan, in the units of the networks.
        networks: actor and critics, which may change in place.
        settings: settings of the search, with horizons in steps.
        worlds: number of worlds in which plans act.
        generator: source of the search's noise.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import TD3Config, TD3Update, make_td3_loss
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> update = TD3Update(make_td3_loss(model, TD3Config()), model, TD3Config())
        >>> search = CEMConfig(planning_horizon=3)
        >>> policy = PlannedActs(model, update.networks, search, worlds=2)
        >>> observation = task.observe(task.coverage.sample([5]))
        >>> policy(update.actor, observation, task.bounds).shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        world_model: TaskWorldModel,
        networks: Networks,
        settings: CEMConfig,
        *,
        worlds: int,
        generator: torch.Generator | None = None,
    ) -> None:
        self.world_model, self.networks, self.settings = world_model, networks, settings
        self.worlds, self.generator = worlds, generator

    @torch.no_grad()
    def __call__(self, weights: Layers, observation: Tensor, bounds: ActionBounds) -> Tensor:
        """Actions ``[N, m]`` for observations ``[N, o]``; ``weights`` are the actor's layers."""
        own = act(weights, observation, bounds)
        first = observation[: self.worlds]
        shape = self.settings.noise_shape((len(first),), own.shape[-1])
        noise = torch.randn(shape, generator=self.generator, device=own.device)
        plan = cem_plan(first, noise, problem=self._problem(bounds), settings=self.settings)
        return torch.cat([plan.actions[:, 0], own[self.worlds :]])

    def _problem(self, bounds: ActionBounds) -> Problem:
        """Model and networks as they are now, for one plan."""
        output = prepare(self.networks.actor)
        critics = [prepare(layers) for layers in _apart(self.networks.critics)]

        def value(observation: Tensor, action: Tensor) -> Tensor:
            inputs = torch.cat([observation, bounds.to_unit(action)], -1)
            return torch.cat([critic(inputs) for critic in critics], -1).amin(-1)

        return Problem(
            model=self.world_model.prepared(),
            bounds=bounds,
            actor=lambda observation: bounds.from_unit(output(observation).tanh()),
            value=value,
        )


def _apart(critics: Layers) -> list[list[Tensor]]:
    """The layers of each critic."""
    return [list(layers) for layers in zip(*(layer.unbind() for layer in critics), strict=True)]
