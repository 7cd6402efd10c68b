"""Which settings of the planner are compared, and which of them go on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch

from phihp_torchrl.planners import SearchConfig
from phihp_torchrl.trainers.calibrate_rule import estimate

# Std of the search near the previous plan, in units of the half-range.
_NARROW = 0.1
# Share of a step's reward below which a promise is rounding.
_NOTHING = 1e-3


@dataclass(frozen=True)
class Trial:
    """The measure of one setting against the actor, over paired imagined starts.

    Args:
        changes: what the setting changes in the planner's.
        steps: steps that were planned before the actor took over.
        differences: return minus that of the actor from the same start, ``[2, episodes]``: from the
            task's starts, and from the second half of the actor's episodes.
        chatter: mean change of the action in units of the half-range, from the second half on.

    Examples:
        >>> trial = Trial({}, 10, ((1.0, 3.0), (0.0, 0.0)), 0.1)
        >>> trial.mean, trial.standard_error
        (2.0, 1.0)
    """

    changes: Mapping[str, Any]
    steps: int
    differences: tuple[tuple[float, ...], ...]
    chatter: float

    @property
    def mean(self) -> float:
        """Gain over the actor from both sorts of starts; -inf where a return is not finite."""
        return estimate(torch.tensor(self.differences, dtype=torch.float64))[0]

    @property
    def standard_error(self) -> float:
        """Standard error of :attr:`mean`."""
        return estimate(torch.tensor(self.differences, dtype=torch.float64))[1]


def rank(trials: Sequence[Trial]) -> list[Trial]:
    """Sort settings, best first.

    Those whose gain is within one standard error of the best's come first, the smoothest of them
    before the others; then those that are worse, by their gain. Chatter is compared to two digits,
    and of equally smooth settings the one of the larger gain comes first.

    Examples:
        >>> jumpy = Trial({}, 10, ((1.0, 2.1, 3.0), (0.0, 0.0, 0.0)), 0.4)
        >>> smooth = Trial({"change_cost": 1.0}, 10, ((1.1, 1.9, 3.0), (0.0, 0.0, 0.0)), 0.01)
        >>> worse = Trial({"alpha": 0.0}, 10, ((-1.0, 0.0, 1.0), (0.0, 0.0, 0.0)), 0.0)
        >>> [trial.chatter for trial in rank([jumpy, worse, smooth])]
        [0.01, 0.4, 0.0]
    """
    best = max(trials, key=lambda trial: trial.mean)

    def key(trial: Trial) -> tuple[float, ...]:
        if not math.isfinite(trial.mean):
            return (1.0, math.inf)
        behind = best.mean - trial.mean
        tied = behind <= best.standard_error
        return (0.0, round(trial.chatter, 2), behind) if tied else (1.0, behind)

    return sorted(trials, key=key)


def grid(config: SearchConfig, promise: float, reward: float) -> list[dict[str, Any]]:
    """The settings that are compared, as changes of ``config``; a key that it lacks is left out.

    A price of changes alone leaves the noise of the search: the mean of a few elites of a wide
    Gaussian. So the calm settings go on from the previous plan, keep it unless another is better,
    and look for others nearby, with noise that is smooth along the plan. Where the actor holds a
    balance, a margin of twice what plans promise there leaves the actor alone; where plans promise
    nothing, there is no margin to try. Without a price the calm search has less of a steady error.

    Args:
        config: the planner's settings.
        promise: what its plans promise beyond the actor where the actor has settled, in units of
            return.
        reward: mean absolute reward of the actor.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> grid(CEMConfig(), 1.0, 1.0)[:2]
        [{}, {'actor_margin': 2.0}]
    """
    margin = {} if promise < _NOTHING * reward else {"actor_margin": _round(2 * promise)}
    standing = {"noise_beta": 2.0, "warm_start": True, "keep_incumbent": True}
    reward, narrow = _round(reward), {"init_std": min(_NARROW, config.init_std)}
    calm = {"change_cost": reward, **standing, **narrow}
    half = max(2, config.planning_horizon // 2)
    wanted: list[dict[str, Any]] = [
        {},
        margin,
        {"change_cost": _round(reward / 10), **standing, "init_std": min(0.3, config.init_std)},
        {**standing, **narrow},
        calm,
        {**calm, **margin},
        {"change_cost": reward, **standing, **margin},
        {"alpha": config.alpha / 2, **margin},
        {"planning_horizon": half, **margin},
    ]
    known = {field.name for field in fields(config)}
    settings: list[dict[str, Any]] = []
    for changes in wanted:
        own = {key: value for key, value in changes.items() if key in known}
        own = {key: value for key, value in own.items() if getattr(config, key) != value}
        if own not in settings:
            settings.append(own)
    return [changes for changes in settings if _fits(config, changes)]


def _fits(config: SearchConfig, changes: Mapping[str, Any]) -> bool:
    try:
        replace(config, **changes)
    except ValueError:
        return False
    return True


def _round(number: float) -> float:
    """A number with two digits, so that a setting can be read."""
    return float(f"{number:.2g}")
