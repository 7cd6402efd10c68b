"""What calibration costs, counted so that every machine plays the same episodes."""

from __future__ import annotations

import copy
from dataclasses import dataclass

from torch import nn

from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import PreparedModel
from phihp_torchrl.planners import SearchConfig
from phihp_torchrl.trainers.calibrate_config import CalibrateConfig

# What a call of the model costs beside its transitions, in transitions of a model whose step has at
# most so many tensor operations. Others cost more in proportion.
_CALL = 1000
_OPERATIONS = 60
# Weights of a network that take as long as a transition of the model.
_WEIGHTS = 10_000
# Episodes that each way plays in any case: below them a standard error says little.
_LEAST = 3
# What all ways may have of the budget. The rest is for the one that is chosen.
_WAYS = 0.45


@dataclass(frozen=True)
class Price:
    """What a plan costs, in transitions of the model.

    Args:
        planner: settings of the planner, with horizons in steps.
        actor: of one action of the actor.
        critics: of one value.
        step: of one step of the model.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> search = CEMConfig(planning_horizon=10, optim_steps=2, num_candidates=50)
        >>> Price(search).plan(4), Price(search, actor=2.0, critics=5.0).plan(4)
        (24000.0, 27600.0)
    """

    planner: SearchConfig
    actor: float = 0.0
    critics: float = 0.0
    step: float = 1.0

    @classmethod
    def of(cls, agent: Agent) -> Price:
        """The price of the plans of an agent, by the size of its networks and of its model."""
        assert agent.planner_config is not None
        networks = _network(agent.actor), _network(agent.qvalue)
        return cls(agent.planner_config, *networks, _step(agent))

    def plan(self, rows: int) -> float:
        """Of a plan for ``rows`` episodes at once, for each step of them."""
        planner = self.planner
        steps = planner.planning_horizon
        assert isinstance(steps, int)  # an agent has resolved its seconds
        calls = planner.optim_steps * steps
        networks = planner.num_policy_candidates * steps * self.actor
        networks += planner.optim_steps * planner.num_candidates * self.critics
        total = calls * self.step * (_CALL + rows * planner.num_candidates) + rows * networks
        return total / getattr(planner, "replan_every", 1)


def of_ways(config: CalibrateConfig) -> float:
    """What all ways may imagine, before one of them plays on."""
    return _WAYS * config.budget


def first_episodes(config: CalibrateConfig, price: Price, steps: float, ways: int) -> int:
    """Episodes that each way of planning plays before there is doubt.

    Args:
        config: settings of the phase.
        price: of a plan.
        steps: of an episode.
        ways: number of ways.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> config = CalibrateConfig()
        >>> [first_episodes(config, Price(CEMConfig(steps)), 500, 4) for steps in (5, 10, 20)]
        [6, 6, 3]
    """
    for episodes in range(config.episodes, min(_LEAST, config.episodes), -1):
        if ways * steps * price.plan(episodes) <= of_ways(config):
            return episodes
    return min(_LEAST, config.episodes)


def _step(agent: Agent) -> float:
    """Transitions of a small model that take as long as one of the agent's, uncompiled."""
    assert agent.dynamics is not None
    dynamics = copy.deepcopy(agent.dynamics)  # without the compiled step, if it has one
    like = next(agent.parameters())
    operations = PreparedModel(agent.task, dynamics, like).operations
    return max(1.0, operations / _OPERATIONS)


def _network(module: nn.Module | None) -> float:
    """Transitions of the model that take as long as a call of a network."""
    if module is None:
        return 0.0
    return 1.0 + sum(weight.numel() for weight in module.parameters()) / _WEIGHTS
