"""What calibration costs, counted so that every machine plays the same episodes."""

from __future__ import annotations

from phihp_torchrl.planners import SearchConfig
from phihp_torchrl.trainers.calibrate_config import CalibrateConfig

# What a call of the model costs beside its transitions, in transitions.
_CALL = 1000
# Episodes below which a standard error says little.
_LEAST = 3


def plan_cost(planner: SearchConfig, rows: int) -> float:
    """Transitions that a plan imagines for ``rows`` episodes at once; a call is a thousand more.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> plan_cost(CEMConfig(planning_horizon=10, optim_steps=2, num_candidates=50), 4)
        24000.0
    """
    steps = planner.planning_horizon
    assert isinstance(steps, int)  # an agent has resolved its seconds
    calls = planner.optim_steps * steps / getattr(planner, "replan_every", 1)
    return calls * (_CALL + rows * planner.num_candidates)


def rounds_cost(config: CalibrateConfig, planner: SearchConfig, episodes: int, count: int) -> float:
    """Transitions of all rounds, which begin with ``count`` settings."""
    rows, total, before = 2 * episodes, 0.0, 0
    whole = config.rounds[-1] + config.follow_steps
    for steps in config.rounds:
        planned = (steps - before) * plan_cost(planner, rows)
        total += count * (planned + (whole - steps) * (_CALL + rows))
        before, count = steps, (count + 1) // 2
    return total


def round_episodes(config: CalibrateConfig, planner: SearchConfig, count: int) -> int:
    """Episodes of the rounds: as many as half of the budget pays, three at least.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> config = CalibrateConfig()
        >>> [round_episodes(config, CEMConfig(steps), 9) for steps in (5, 8, 100)]
        [6, 5, 3]
    """
    fits = [
        episodes
        for episodes in range(_LEAST, config.episodes + 1)
        if rounds_cost(config, planner, episodes, count) <= config.budget / 2
    ]
    return max(fits, default=min(_LEAST, config.episodes))


def final_steps(config: CalibrateConfig, planner: SearchConfig, rest: float, longest: int) -> int:
    """Steps that two plans play at the end, before the actor takes over.

    They take half of what is left: the other half is for more episodes, in doubt.

    Args:
        config: settings of the phase.
        planner: settings of the planner.
        rest: what the rounds have left of the budget.
        longest: steps of a whole episode.
    """
    affordable = int(rest / 2 / (2 * plan_cost(planner, 2 * config.episodes)))
    return min(longest, max(config.rounds[-1], affordable))
