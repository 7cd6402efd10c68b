"""Whether constants stay where they are when the equations may leave something out.

An interval tells how far noise may have moved a constant. What the equations leave out moves it
too, and no covariance of the fit knows that. So where a fit leaves more than noise, it is done
again with terms added that a missing friction, spring or offset would have, and constants that move
are said to hold for complete equations alone.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.dynamics import PhysicsPrior
from phihp_torchrl.identification.covariance import Uncertainty, uncertainty
from phihp_torchrl.identification.fitting import Fitted
from phihp_torchrl.identification.model import Model
from phihp_torchrl.identification.parts import IDENTIFIED, IF_COMPLETE, Estimate
from phihp_torchrl.identification.settling import settle
from phihp_torchrl.identification.shooting import Fit, Shooting
from phihp_torchrl.identification.verdicts import judge_combinations, judge_constants, scale_of
from phihp_torchrl.identification.windows import Samples
from phihp_torchrl.systems import Constant, System

_REACH = 2.0
"""Largest size of an added term, in standard deviations of what it is added to."""
_SLOW = 0.1
"""Share of a usual speed from which on dry friction is whole."""
_WIDER = 1.5
"""How much wider an interval may become that is still what the data say by themselves."""


@dataclass(frozen=True)
class Loosened:
    """A fit of equations with added terms.

    Args:
        constants: what it says of the constants.
        combinations: what it says of combinations of them.
    """

    constants: Mapping[str, Estimate]
    combinations: Mapping[str, Estimate]


def loosen(fitted: Fitted, samples: Samples) -> Loosened:
    """Fit what was fitted again, with terms added that a missing force would have."""
    model, fit = fitted.model, fitted.fit
    system = loosened_system(model.prior.system, fit.states, fitted.windows.time)
    prior = PhysicsPrior(system).double()
    count = len(prior.learned) - model.constants
    wide = replace(model, prior=prior)
    raw = torch.cat(
        [fit.raw[: model.constants], fit.raw.new_zeros(count), fit.raw[model.constants :]]
    )
    shooting = Shooting(wide, samples, fitted.windows)
    found = settle(shooting, raw, fit.starts, fit.sigma, rounds=2, iterations=10)
    doubt = uncertainty(found, scale_of(wide, found.raw))
    return Loosened(*_judged(wide, found, doubt))


def _judged(
    model: Model, fit: Fit, doubt: Uncertainty
) -> tuple[Mapping[str, Estimate], Mapping[str, Estimate]]:
    constants = judge_constants(model, fit.raw, doubt, lambda direction: "")
    return constants, judge_combinations(model, fit.raw, doubt)


def loosened_system(system: System, states: Tensor, time: Tensor) -> System:
    """The system with linear terms of its speeds, dry friction and an offset in each acceleration.

    States without a velocity of their own, such as levels, count as speeds.

    Args:
        system: the system.
        states: states along trajectories, ``[W, L, n]``, which tell the usual sizes.
        time: their times, ``[W, L]``.
    """
    names = system.state_names
    moving = [i for i, name in enumerate(names) if name not in system.velocity_of]
    step = time.diff(dim=1)[..., None]
    slope = (states.diff(dim=1) / step.clamp_min(1e-12))[(step > 0)[..., 0]]
    rate, size = slope.std(0).clamp_min(1e-9), states.flatten(0, 1).square().mean(0).sqrt()
    size = size.clamp_min(1e-9)
    terms = {f"{names[j]} in {names[i]}": (i, j) for i in moving for j in moving}
    extra = [*terms, *(f"{kind} of {names[i]}" for i in moving for kind in ("friction", "offset"))]

    def added(state: Tensor, constants: Mapping[str, Tensor]) -> Tensor:
        columns = list(torch.zeros_like(state).unbind(-1))
        for name, (i, j) in terms.items():
            columns[i] = columns[i] + rate[i] * constants[name] * state[..., j] / size[j]
        for i in moving:
            dry = (state[..., i] / (_SLOW * size[i])).tanh()
            own = constants[f"friction of {names[i]}"] * dry + constants[f"offset of {names[i]}"]
            columns[i] = columns[i] + rate[i] * own
        return torch.stack(columns, -1)

    base: Any = type(system)

    class Loose(base):
        def prior(self, state: Tensor, action: Tensor, constants: Mapping[str, Any]) -> Tensor:
            # A prior may go through its constants in turn, so it sees none but its own.
            ours = {name: constants[name] for name in system.ranges}
            ahead: Tensor = super().prior(state, action, ours)
            return ahead + added(state, constants)

    loose: System = copy.copy(system)
    loose.__class__ = Loose
    loose.ranges = {**system.ranges, **{n: Constant(0.0, -_REACH, _REACH) for n in extra}}
    return loose


def doubted(
    estimates: Mapping[str, Estimate], loose: Mapping[str, Estimate]
) -> dict[str, Estimate]:
    """Estimates whose intervals hold what a fit with added terms says as well.

    Examples:
        >>> gravity = Estimate(9.0, 8.46, 8.0, 8.94)
        >>> found = doubted({"gravity": gravity}, {"gravity": Estimate(9.0, 9.7, 9.5, 9.9)})
        >>> found["gravity"].low, found["gravity"].high, found["gravity"].verdict
        (8.0, 9.9, 'identified only if the equations are complete')
    """
    return {name: _doubted(e, loose.get(name)) for name, e in estimates.items()}


def _doubted(e: Estimate, other: Estimate | None) -> Estimate:
    if e.verdict != IDENTIFIED or e.low is None or e.high is None or other is None:
        return e
    if other.verdict != IDENTIFIED or other.low is None or other.high is None:
        advice = (
            "Friction, a spring or an offset could do what it does, and the equations leave "
            "something out. Add the term that is missing."
        )
        return replace(e, verdict=IF_COMPLETE, advice=advice)
    low, high = min(e.low, other.low), max(e.high, other.high)
    stays = e.low <= other.estimate <= e.high
    if stays and high - low <= _WIDER * (e.high - e.low):
        return replace(e, low=low, high=high)
    advice = (
        f"With friction, linear terms and offsets added it comes out as {other.estimate:.4g} "
        f"[{other.low:.4g}, {other.high:.4g}], and the interval holds both. Add the term that is "
        "missing."
    )
    return replace(e, low=low, high=high, verdict=IF_COMPLETE, advice=advice)
