"""The ways to plan that calibration compares, as changes of the planner's settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

from phihp_torchrl.planners import FAST_LIMITS, SearchConfig

LEAVING = ("leaving", "priced")
"""The ways that leave an actor alone where it rests."""

# Share of a step's reward below which a promise is rounding.
_NOTHING = 1e-3
# Margin in units of what most plans promise where the actor rests: near enough to none exceeds it.
_ABOVE = 5.0
# A search that goes on from the previous plan, and keeps it unless another is better.
_STANDING = {"noise_beta": 2.0, "warm_start": True, "keep_incumbent": True}
# Std of the search near the previous plan, in units of the half-range.
_NEAR, _NEARER, _NEAREST = 0.3, 0.1, 0.03
# Steps of the calmest plan, at most.
_STILL_STEPS = 10


def leaving(config: SearchConfig, promise: float, reward: float) -> dict[str, dict[str, Any]]:
    """Two ways to plan that leave the actor alone where it rests, by name.

    Their margin is five times what plans promise there, and counts only there. A plan that leaves
    the actor all the same may find it worth its while to go on; the second way keeps it from that
    by a price of changes.

    Args:
        config: the planner's settings.
        promise: what its plans promise beyond the actor where that rests, in units of return.
        reward: mean absolute reward of a step, the price of a full change of the action.

    Returns:
        The changes; none where plans promise nothing, or where a planner has no margin.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> ways = leaving(CEMConfig(warm_start=True, noise_beta=2.0), 1.0, 0.5)
        >>> ways["leaving"]
        {'actor_margin': 5.0, 'margin_at_rest': True}
        >>> ways["priced"]
        {'change_cost': 0.5, 'keep_incumbent': True, 'actor_margin': 5.0, 'margin_at_rest': True}
        >>> leaving(CEMConfig(), 0.0, 1.0)
        {}
    """
    margin = _fitting(config, {"actor_margin": _round(_ABOVE * promise), "margin_at_rest": True})
    if promise < _NOTHING * reward or not margin:
        return {}
    priced = _fitting(config, {"change_cost": _round(reward), **_STANDING, **margin})
    return {"leaving": margin, **({"priced": priced} if priced else {})}


def calmer(config: SearchConfig, reward: float) -> dict[str, dict[str, Any]]:
    """Four ways to plan calmly, by name, the calmest first.

    A price of changes alone leaves the noise of the search: the mean of a few elites of a wide
    Gaussian. So these go on from the previous plan, keep it unless another is better, and look for
    others nearby, with noise that is smooth along the plan. The price is that of a full change of
    the action in units of a step's reward: the dearer, the calmer, and the larger the steady error
    that a plan does not find worth a change. The calmest plans ten steps ahead at most, in two
    iterations: corrections are small there, and few candidates find them in few dimensions alone.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> ways = calmer(CEMConfig(), 1.0)
        >>> [(name, way["change_cost"], way["init_std"]) for name, way in ways.items()]
        [('still', 10.0, 0.03), ('calm', 1.0, 0.1), ('mild', 0.1, 0.1), ('loose', 0.33, 0.3)]
    """
    steps = config.planning_horizon
    short = {"planning_horizon": min(steps, _STILL_STEPS)} if isinstance(steps, int) else {}
    still = {**short, "optim_steps": max(config.optim_steps, 2)}
    kinds: tuple[tuple[str, float, float, dict[str, Any]], ...] = (
        ("still", 10.0, _NEAREST, still),
        ("calm", 1.0, _NEARER, {}),
        ("mild", 0.1, _NEARER, {}),
        ("loose", 1 / 3, _NEAR, {}),
    )
    ways = {}
    for name, share, near, more in kinds:
        price, std = share * reward, min(near, config.init_std)
        wanted = {"change_cost": _round(price), **_STANDING, "init_std": std, **more}
        if changes := _fitting(config, wanted):
            ways[name] = changes
    return ways


def faster(config: SearchConfig, changes: Mapping[str, Any]) -> dict[str, Any]:
    """A way to plan on the fast budget, as changes of the planner's settings.

    Args:
        config: the planner's settings.
        changes: those of the way, which it keeps.

    Returns:
        The changes; none where the way is as cheap already, or where other settings, such as more
        kept elites than there are elites, do not fit them.

    Examples:
        >>> from phihp_torchrl.planners import CEMConfig
        >>> faster(CEMConfig(planning_horizon=2, num_candidates=64, top_k=4), {"noise_beta": 2.0})
        {'noise_beta': 2.0, 'num_candidates': 32, 'num_policy_candidates': 8}
        >>> faster(CEMConfig(planning_horizon=3, num_candidates=32, num_policy_candidates=4), {})
        {}
    """
    known = {field.name for field in fields(config)}
    less = {name: most for name, most in FAST_LIMITS.items() if name in known}
    less = {name: most for name, most in less.items() if getattr(config, name) > most}
    cheap = _fitting(config, {**changes, **less})
    return cheap if less else {}


def _fitting(config: SearchConfig, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the changes that the settings know and do not have yet; none if they do not fit."""
    known = {field.name for field in fields(config)}
    own = {key: value for key, value in changes.items() if key in known}
    own = {key: value for key, value in own.items() if getattr(config, key) != value}
    try:
        replace(config, **own)
    except ValueError:
        return {}
    return own


def _round(number: float) -> float:
    """A number with two digits, so that a setting can be read."""
    return float(f"{number:.2g}")
