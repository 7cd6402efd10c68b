"""What calibration costs, counted so that every machine plays the same episodes."""

from __future__ import annotations

from dataclasses import dataclass

from torch import nn

from phihp_torchrl.deployment import Agent
from phihp_torchrl.planners import SearchConfig
from phihp_torchrl.trainers.calibrate_config import CalibrateConfig

# What a call of the model costs beside its transitions, in transitions.
_CALL = 1000
# Weights of a network that take as long as a transition of the model.
_WEIGHTS = 10_000
# Episodes below which a standard error says little, and steps below which a plan shows nothing.
_LEAST, _FEWEST, _ENOUGH = 3, 3, 16
# Of what the rounds leave, the share of the first episodes at the end; the rest is for doubt.
_FIRST = 0.25


@dataclass(frozen=True)
class Price:
    """What a plan costs, in transitions of the model.

    Args:
        planner: settings of the planner, with horizons in steps.
        actor: of one action of the actor.
        critics: of one value.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> search = CEMConfig(planning_horizon=10, optim_steps=2, num_candidates=50)
        >>> Price(search).plan(4), Price(search, actor=2.0, critics=5.0).plan(4)
        (24000.0, 27600.0)
    """

    planner: SearchConfig
    actor: float = 0.0
    critics: float = 0.0

    @classmethod
    def of(cls, agent: Agent) -> Price:
        """The price of the plans of an agent, by the size of its networks."""
        assert agent.planner_config is not None
        return cls(agent.planner_config, _network(agent.actor), _network(agent.qvalue))

    def plan(self, rows: int) -> float:
        """Of a plan for ``rows`` episodes at once, for each step of them."""
        planner = self.planner
        steps = planner.planning_horizon
        assert isinstance(steps, int)  # an agent has resolved its seconds
        calls = planner.optim_steps * steps
        networks = planner.num_policy_candidates * steps * self.actor
        networks += planner.optim_steps * planner.num_candidates * self.critics
        total = calls * (_CALL + rows * planner.num_candidates) + rows * networks
        return total / getattr(planner, "replan_every", 1)


def rounds_cost(
    config: CalibrateConfig, price: Price, rounds: tuple[int, ...], episodes: int, count: int
) -> float:
    """Transitions of ``rounds`` of so many planned steps, which begin with ``count`` settings."""
    rows, total, before = 2 * episodes, 0.0, 0
    for steps in rounds:
        planned = (steps - before) * price.plan(rows)
        total += count * (planned + config.follow_steps * (_CALL + rows))
        before, count = steps, (count + 1) // 2
    return total


def fit_rounds(config: CalibrateConfig, price: Price, count: int) -> tuple[tuple[int, ...], int]:
    """Planned steps of the rounds, and their episodes, for half of the budget.

    Where that does not pay for all, there are fewer episodes, three at least; then fewer steps,
    three at least, and one more in each round.

    Args:
        config: settings of the phase.
        price: of a plan.
        count: settings in the first round.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> config = CalibrateConfig()
        >>> [fit_rounds(config, Price(CEMConfig(steps)), 9) for steps in (5, 20, 100)]
        [((10, 30), 6), ((5, 15), 3), ((3, 4), 3)]
    """
    most = config.rounds[-1]
    for episodes in range(config.episodes, min(_LEAST, config.episodes) - 1, -1):
        if rounds_cost(config, price, config.rounds, episodes, count) <= config.budget / 2:
            return config.rounds, episodes
    rounds = config.rounds
    for last in range(most - 1, 0, -1):
        rounds = _shorter(config.rounds, last / most)
        if rounds_cost(config, price, rounds, episodes, count) <= config.budget / 2:
            break
    return rounds, episodes


def final_steps(
    config: CalibrateConfig, price: Price, rest: float, least: int, longest: int
) -> int:
    """Steps that two plans play at the end, before the actor takes over.

    The first episodes take a quarter of what is left, so that their number can double twice in
    doubt; more, where a quarter pays for less than sixteen steps.

    Args:
        config: settings of the phase.
        price: of a plan.
        rest: what the rounds have left of the budget.
        least: steps that are played in any case.
        longest: steps of a whole episode.
    """
    affordable = rest / (2 * price.plan(2 * config.episodes))
    steps = max(int(_FIRST * affordable), min(int(affordable), _ENOUGH), least)
    return min(longest, steps)


def _shorter(rounds: tuple[int, ...], share: float) -> tuple[int, ...]:
    """Rounds of fewer steps, which still rise."""
    shorter: list[int] = []
    for steps in rounds:
        least = shorter[-1] + 1 if shorter else min(_FEWEST, rounds[0])
        shorter.append(max(least, int(share * steps)))
    return tuple(shorter)


def _network(module: nn.Module | None) -> float:
    """Transitions of the model that take as long as a call of a network."""
    if module is None:
        return 0.0
    return 1.0 + sum(weight.numel() for weight in module.parameters()) / _WEIGHTS
