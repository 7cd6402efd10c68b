"""What a fit says of each constant: an estimate, an interval, and whether the data determine it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor

from phihp_torchrl.identification.covariance import SHARE, Uncertainty, monomials
from phihp_torchrl.identification.model import Model, part_of
from phihp_torchrl.identification.parts import (
    AT_LIMIT,
    COMBINED,
    FIXED,
    NOT_IDENTIFIED,
    ActuatorEstimate,
    ActuatorTrial,
    Estimate,
)
from phihp_torchrl.systems import Constant, System
from phihp_torchrl.tasks import Numbers

_NEAR = 0.01
"""Share of its range, or of its first guess, at which a constant counts as at its limit."""
_ADVICE_LIMIT = "Widen its range if it may lie beyond, or leave out the term that it belongs to."


def scale_of(model: Model, raw: Tensor) -> Tensor:
    """Derivatives of logarithms (or shares of a range around zero) by the parameters, ``[p]``."""
    scale = torch.ones_like(raw)
    for i, name in enumerate(model.prior.learned):
        c = model.prior.ranges[name]
        if c.bounded:
            share = raw[i].sigmoid()
            slope = (c.high - c.low) * share * (1.0 - share)
            value = c.low + (c.high - c.low) * share
            around_zero = c.low < 0 < c.high
            scale[i] = slope / (c.high - c.low if around_zero else value.abs().clamp_min(1e-12))
    for i, part in enumerate(model.fitted, start=model.constants):
        if part_of(part)[0] == "delay_steps":
            scale[i] = 1.0 / raw[i].abs().clamp_min(1.0)
    return scale


def judge_constants(
    model: Model, raw: Tensor, doubt: Uncertainty, advise: Callable[[Tensor], str]
) -> dict[str, Estimate]:
    """The verdict on each constant.

    Args:
        model: names, first guesses and kinds of the constants.
        raw: the fitted parameters ``[p]``.
        doubt: how sure they are.
        advise: what would tell a direction ``[p]`` of the parameters.
    """
    values = {name: float(v) for name, v in model.prior.decode(raw[: model.constants]).items()}
    found = {}
    for name, c in model.prior.ranges.items():
        if c.fixed:
            found[name] = Estimate(c.guess, c.guess, c.guess, c.guess, FIXED)
            continue
        i = model.prior.learned.index(name)
        unit = torch.zeros_like(raw)
        unit[i] = 1.0
        rows = doubt.open[doubt.open[:, i].abs() > SHARE]
        partners = [
            other
            for j, other in enumerate([*model.prior.learned, *model.fitted])
            if j != i and bool((rows[:, j].abs() > SHARE).any())
        ]
        if limit := _limit(c, values[name], doubt, i, alone=not partners):
            found[name] = Estimate(c.guess, values[name], *limit, AT_LIMIT, _ADVICE_LIMIT)
        elif len(rows):
            verdict = COMBINED + ", ".join(partners) if partners else NOT_IDENTIFIED
            found[name] = Estimate(
                c.guess, values[name], None, None, verdict, advise(rows[0] / doubt.scale)
            )
        else:
            shift = unit * doubt.reach(unit) / doubt.scale
            low, high = (
                float(model.prior.decode((raw + sign * shift)[: model.constants])[name])
                for sign in (-1.0, 1.0)
            )
            found[name] = Estimate(c.guess, values[name], low, high)
    return found


def _limit(
    c: Constant, value: float, doubt: Uncertainty, i: int, *, alone: bool
) -> tuple[float, float] | None:
    """The interval of a constant at its limit; ``None`` for one that is elsewhere."""
    if c.bounded:
        share = (value - c.low) / (c.high - c.low)
        if share < _NEAR:
            return c.low, c.low + 2.0 * _NEAR * (c.high - c.low)
        return (c.high - 2.0 * _NEAR * (c.high - c.low), c.high) if share > 1 - _NEAR else None
    vanished = alone and value < _NEAR * c.guess and bool((doubt.open[:, i].abs() > SHARE).any())
    return (0.0, _NEAR * c.guess) if vanished else None


def judge_combinations(model: Model, raw: Tensor, doubt: Uncertainty) -> dict[str, Estimate]:
    """Estimates of combinations: those that the system declares, and products that were found.

    Args:
        model: the system and its constants.
        raw: the fitted parameters ``[p]``.
        doubt: how sure they are.
    """
    system = model.prior.system
    guesses = system.constants
    found = {}
    for name in system.identifiable(guesses):
        if name not in guesses:
            found[name] = _combination(model, raw, doubt, partial(_declared, system, name))
    positive = [
        i
        for i, name in enumerate(model.prior.learned)
        if not model.prior.ranges[name].bounded or model.prior.ranges[name].low >= 0
    ]
    for exponents in monomials(doubt.open, positive):
        powers = {model.prior.learned[i]: power for i, power in exponents.items()}
        if len(powers) > 1:
            estimate = _combination(model, raw, doubt, partial(_product, powers))
            if estimate.low is not None:
                found[product_name(powers)] = estimate
    return found


def _declared(system: System, name: str, constants: Mapping[str, Tensor]) -> Tensor:
    return torch.as_tensor(system.identifiable(constants)[name])


def _product(powers: Mapping[str, float], constants: Mapping[str, Tensor]) -> Tensor:
    value = torch.ones((), dtype=torch.float64)
    for name, power in powers.items():
        value = value * constants[name] ** power
    return value


def _combination(
    model: Model, raw: Tensor, doubt: Uncertainty, combine: Callable[[Mapping[str, Tensor]], Tensor]
) -> Estimate:
    """One combination, its interval by the slope of its value (delta method)."""
    guess = model.first()
    nudges = 1e-5 * torch.eye(len(raw), dtype=raw.dtype)
    value, first, high, low = (
        combine(model.prior.decode(x[..., : model.constants]))
        for x in (raw, guess, raw + nudges, raw - nudges)
    )
    slope = ((high - low) / 2e-5).expand(len(raw)) / doubt.scale
    if doubt.touches(slope):
        advice = "Give fewer constants, or see what would identify those that it is made of."
        return Estimate(float(first), float(value), None, None, NOT_IDENTIFIED, advice)
    reach = doubt.reach(slope)
    v = float(value)
    if v > 0 and reach < v:
        return Estimate(float(first), v, v * math.exp(-reach / v), v * math.exp(reach / v))
    return Estimate(float(first), v, v - reach, v + reach)


def product_name(powers: Mapping[str, float]) -> str:
    """A product of powers as text.

    Examples:
        >>> product_name({"gain": 1.0, "mass": -1.0, "length": -2.0})
        'gain / (mass * length^2)'
    """
    up, down = (
        [f"{n}^{abs(p):.3g}" if abs(p) != 1 else n for n, p in powers.items() if sign * p > 0]
        for sign in (1, -1)
    )
    below = f"({' * '.join(down)})" if len(down) > 1 else "".join(down)
    above = " * ".join(up) or "1"
    return f"{above} / {below}" if below else above


def judge_actuator(
    model: Model, raw: Tensor, doubt: Uncertainty, tried: tuple[ActuatorTrial, ...]
) -> ActuatorEstimate:
    """The path of the command, with intervals of the parts that were fitted."""
    path = model.actuator(raw)
    intervals = {}
    for i, part in enumerate(model.fitted, start=model.constants):
        unit = torch.zeros_like(raw)
        unit[i] = 1.0
        shift = unit * doubt.reach(unit) / doubt.scale
        if not doubt.touches(unit):
            low, high = (model.number(model.actuator(raw + sign * shift), part) for sign in (-1, 1))
            intervals[part.replace("lag", "lag_s", 1) if part[:3] == "lag" else part] = (low, high)
    return ActuatorEstimate(
        delay_steps=_same(path.delay_steps),
        lag_s=_same(path.lag),
        slew=None if path.slew is None else _one(path.slew),
        dead_zone=_same(path.dead_zone),
        gain_low=_same(path.gain_low),
        intervals=intervals,
        tried=tried,
        actions=model.actions,
    )


def _same(value: Numbers) -> Numbers:
    """One number where that of every action is the same."""
    return value[0] if isinstance(value, tuple) and len(set(value)) == 1 else value


def _one(value: Numbers) -> float:
    """The number of all actions."""
    return value[0] if isinstance(value, tuple) else value
