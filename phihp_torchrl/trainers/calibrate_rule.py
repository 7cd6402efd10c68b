"""The rule by which a way to plan, or the actor, is chosen from imagined episodes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch

from phihp_torchrl.planners import RESTS

# Of the return, what smoothness may cost: it is less than anybody would notice. A plan that rests
# where the other does not is worth a little more.
_TRIFLE, _REST = 3e-3, 1e-2
# Returns in two models differ by more than this share of them: more than smoothness may cost.
_ALIKE = 0.02
# Chatter of the smoother plan, as a share of the other's; and the least difference of the two.
_SMOOTHER, _NOTICEABLE = 2 / 3, 0.01


@dataclass(frozen=True)
class Way:
    """What a way to act earned in imagined episodes.

    Args:
        returns: return of each episode, from the same starts and with the same noise for all.
        chatter: mean change of the action in each, in units of the half-range.
        changes: what it changes in the settings of the planner.

    Examples:
        >>> Way((1.0, 3.0), (0.0, 0.2)).ahead_of(Way((0.0, 0.0), (0.0, 0.0)))
        (2.0, 1.0)
    """

    returns: tuple[float, ...]
    chatter: tuple[float, ...]
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def mean_return(self) -> float:
        """Mean of the returns."""
        return sum(self.returns) / len(self.returns)

    @property
    def mean_chatter(self) -> float:
        """Mean of the chatter over episodes."""
        return sum(self.chatter) / len(self.chatter)

    def ahead_of(self, other: Way) -> tuple[float, float]:
        """Mean paired difference of the returns, and its standard error.

        Where one has played more episodes, these are left out. It is minus infinity where one of
        ours is not finite, and infinity where one of the other's is not.
        """
        count = min(len(self.returns), len(other.returns))
        ours, theirs = self.returns[:count], other.returns[:count]
        if not all(map(math.isfinite, ours)):
            return -math.inf, 0.0
        if not all(map(math.isfinite, theirs)):
            return math.inf, 0.0
        gap = torch.tensor(ours).double() - torch.tensor(theirs).double()
        return gap.mean().item(), (gap.std() / len(gap) ** 0.5).item()

    def smoother_than(self, other: Way) -> bool:
        """Whether its chatter is clearly less: two thirds at most."""
        ours, theirs = self.mean_chatter, other.mean_chatter
        return ours <= _SMOOTHER * theirs and theirs - ours >= _NOTICEABLE


class Choice(NamedTuple):
    """What :func:`choose` has chosen.

    Attributes:
        name: name of the way to plan.
        acting: who acts, ``"planner"`` or ``"actor"``.
        certain: whether more episodes would not change who acts.
        gain: mean return of the plan beyond the actor's.
        gain_error: its standard error, paired.
    """

    name: str
    acting: str
    certain: bool
    gain: float
    gain_error: float

    @property
    def is_tie(self) -> bool:
        """Whether plan and actor earn exactly the same in each episode."""
        return self.gain == self.gain_error == 0.0


def choose(
    ways: Mapping[str, Way], actor: Way, *, confidence: float = 2.0, doubted: bool = False
) -> Choice:
    """Choose one way to plan, and then between that and the actor.

    The first way stays unless another

    - earns more, by over ``confidence`` standard errors of the paired differences, or
    - is not behind the actor where the first is, by over one standard error.

    Of those that are clearly smoother than what stays, with at most two thirds of its chatter, the
    smoothest takes its place that does not earn less than what smoothness may cost: 0.3 % of the
    return, or 1 % for one that rests in the end, which may earn less by a standard error more, but
    no more than twice what it may cost.
    None does that falls behind the actor, by over one standard error, unless that is smoother too.

    The plan that is chosen acts if it earns more than the actor by over one standard error; else
    the actor does, which is cheaper. Where both earn exactly the same in each episode, a plan that
    is clearly smoother acts. Beyond ``confidence`` standard errors, on either side, the choice is
    certain; all else is doubtful and deserves more episodes. Those are a second look at the same
    question, which a bound of two standard errors passes a little more often than one look would.

    Where the model itself is doubted, the plan acts unless it is certain to earn less. It answers
    at every step to where the world has gone; the actor has learned in that model alone, in which
    it looks better than it is.

    Args:
        ways: what each way to plan earned, by name; the first is the one to be replaced.
        actor: what the actor alone earned.
        confidence: standard errors of a difference that is no chance.
        doubted: whether models that fit the data as well disagree (:func:`in_doubt`).

    Examples:
        >>> given = Way((10.0, 12.0, 11.0), (0.4, 0.4, 0.4))
        >>> smooth = Way((10.0, 12.1, 11.0), (0.1, 0.1, 0.1), {"change_cost": 1.0})
        >>> actor = Way((5.0, 6.0, 7.0), (0.0, 0.0, 0.0))
        >>> choice = choose({"given": given, "calm": smooth}, actor)
        >>> choice.name, choice.acting, choice.certain
        ('calm', 'planner', True)
    """
    behind = {name: _behind(way, actor, confidence) for name, way in ways.items()}
    name, *others = ways
    for other in others:
        ahead, error = ways[other].ahead_of(ways[name])
        if ahead > confidence * error or (behind[name] and not behind[other]):
            name = other
    best = ways[name]
    calm = {
        other: way.mean_chatter
        for other, way in ways.items()
        if way.smoother_than(best)
        and costs_little(way, best)
        and (behind[name] or not behind[other] or actor.smoother_than(best))
    }
    name = min(calm, key=calm.__getitem__, default=name)
    plan = ways[name]
    gain, error = plan.ahead_of(actor)
    same = gain == error == 0.0
    if same:
        acts = plan.smoother_than(actor)
    elif doubted:
        acts = gain >= -confidence * error
    else:
        acts = gain > min(confidence, 1.0) * error
    certain = same or abs(gain) > confidence * error
    return Choice(name, "planner" if acts else "actor", certain, gain, error)


def in_doubt(own: Way, others: Sequence[Way], *, confidence: float = 2.0) -> bool:
    """Whether models that fit the data about as well disagree about what the actor earns.

    Then a plan that costs nothing in one of them may cost much in the world: whoever plans by a
    model finds what it is wrong about.

    Args:
        own: what the actor earned in the model by which plans are made.
        others: what it earned in each of the others, from the same starts.
        confidence: standard errors of a difference that is no chance.

    Examples:
        >>> own, other = Way((10.0, 12.0), (0.0, 0.0)), Way((7.0, 8.0), (0.0, 0.0))
        >>> in_doubt(own, [own]), in_doubt(own, [own, other])
        (False, True)
    """
    gaps = (other.ahead_of(own) for other in others)
    least = _ALIKE * abs(own.mean_return)
    return any(abs(gap) > max(least, confidence * error) for gap, error in gaps)


def costs_little(way: Way, best: Way, *, steadier: bool = False) -> bool:
    """Whether a way earns as much as the best, but for what its smoothness may cost.

    That is 0.3 % of the return, or 1 % where it rests and the best does not; and a standard error
    more, at most as much again, for one that rests.

    Args:
        way: what the way earned.
        best: what the best has earned.
        steadier: whether it is worth as much as rest for another reason.
    """
    rests = steadier or way.mean_chatter <= RESTS
    share = _REST if rests and (steadier or best.mean_chatter > RESTS) else _TRIFLE
    allowed = share * abs(best.mean_return)
    ahead, error = way.ahead_of(best)
    return ahead >= -allowed - (min(error, allowed) if rests else 0.0)


def loses_nothing(cheap: Way, plan: Way, *, confidence: float = 2.0) -> bool:
    """Whether a cheaper plan earns as much as another, and is as smooth, or clearly earns more.

    It is shown to lose less than 0.3 % of the return, by one standard error; that nothing is known
    of a loss is not enough. One that earns more by ``confidence`` standard errors than a plan that
    does not rest need not be as smooth: where motion is chaotic, plans that look far ahead lose to
    short ones and Q.

    Examples:
        >>> plan = Way((100.0, 98.0, 99.0), (0.0, 0.0, 0.0))
        >>> loses_nothing(Way((100.0, 98.1, 98.9), (0.0, 0.0, 0.0)), plan)
        True
        >>> loses_nothing(Way((102.0, 95.0, 101.0), (0.0, 0.0, 0.0)), plan)
        False
        >>> rough = Way((120.0, 118.0, 118.0), (0.5, 0.5, 0.5))
        >>> restless = Way((100.0, 98.0, 99.0), (0.4, 0.4, 0.4))
        >>> loses_nothing(rough, plan), loses_nothing(rough, restless)
        (False, True)
    """
    ahead, error = cheap.ahead_of(plan)
    calm = cheap.mean_chatter < plan.mean_chatter + _NOTICEABLE
    trifle = _TRIFLE * abs(plan.mean_return)
    better = ahead > max(trifle, confidence * error) and plan.mean_chatter > RESTS
    return better or (calm and ahead - error >= -trifle)


def _behind(plan: Way, actor: Way, confidence: float) -> bool:
    """Whether a plan earns less than the actor by over one standard error."""
    gain, error = plan.ahead_of(actor)
    return gain < 0.0 and gain <= -min(confidence, 1.0) * error
