"""The rule by which settings of the planner, or the actor, are chosen from imagined episodes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

# Of the plan's gain over the actor, what smoothness may cost.
_SHARE = 0.1
# And of the actor's return, if that is more: it is less than anybody would notice.
_TRIFLE = 1e-3
# Chatter of the smoother plan, as a share of the other's; and the least difference of the two.
_SMOOTHER, _NOTICEABLE = 2 / 3, 0.01


@dataclass(frozen=True)
class Finalist:
    """What a way to act earned in imagined episodes.

    Args:
        returns: return of each episode, from the same starts and with the same noise for all.
        chatter: mean change of the action in each, in units of the half-range.
        changes: what it changes in the settings of the planner.
        late: return of each stretch from the second half of the actor's episodes; none by default.
        weight: how many such stretches an episode has, as often as their differences count at most.
    """

    returns: tuple[float, ...]
    chatter: tuple[float, ...]
    changes: Mapping[str, Any] = field(default_factory=dict)
    late: tuple[float, ...] = ()
    weight: float = 1.0

    @property
    def mean_chatter(self) -> float:
        """Mean of the chatter over episodes."""
        return sum(self.chatter) / len(self.chatter)

    @property
    def fails(self) -> bool:
        """Whether a return is not finite."""
        return not all(map(math.isfinite, self.returns + self.late))

    def ahead_of(self, other: Finalist) -> tuple[float, float]:
        """Mean paired difference of an episode's return, and its standard error.

        It is that of :attr:`returns`, and that of late stretches times :func:`late_weight`.
        """
        rows = [self.returns, self.late] if self.late else [self.returns]
        against = [other.returns, other.late] if self.late else [other.returns]
        differences = torch.tensor(rows).double() - torch.tensor(against).double()
        if self.late:
            differences[1] *= late_weight(differences, self.weight)
        return estimate(differences)

    def smoother_than(self, other: Finalist) -> bool:
        """Whether its chatter is clearly less: two thirds at most."""
        ours, theirs = self.mean_chatter, other.mean_chatter
        return ours <= _SMOOTHER * theirs and theirs - ours >= _NOTICEABLE


class Choice(NamedTuple):
    """What :func:`choose` has chosen.

    Attributes:
        plan: the plan.
        reason: why this one: ``"as given"``, ``"better"`` or ``"smoother"``.
        acting: who acts, ``"planner"`` or ``"actor"``.
        certain: whether more episodes would not change who acts.
        gain: mean return of the plan beyond the actor's.
        gain_error: its standard error, paired.
    """

    plan: Finalist
    reason: str
    acting: str
    certain: bool
    gain: float
    gain_error: float


def choose(
    given: Finalist, other: Finalist | None, actor: Finalist, *, confidence: float = 2.0
) -> Choice:
    """Choose between the plan as given and one other, and between the plan and the actor.

    The plan as given stays unless the other one

    - earns more, by over ``confidence`` standard errors of the paired differences, or
    - is clearly smoother, with at most two thirds of the chatter, and does not earn less by more
      than a tenth of the given plan's gain over the actor, or a thousandth of the actor's return.

    The plan that is chosen acts unless the actor earns more by over one standard error: a plan
    looks further than its actor and is compared with it at every step, so what is in doubt is more
    likely a gain. Beyond ``confidence`` standard errors, on either side, the choice is certain;
    all else is doubtful and deserves more episodes. Where both earn exactly the same in each, the
    actor, which is cheaper, acts, unless the plan is clearly smoother.

    One other plan is compared and not a dozen, because the best of a dozen looks better than it is.
    The one that enters here was picked by other episodes, so its differences here are not favoured
    by the pick. Episodes that are added in doubt are a second look at the same question, which a
    bound of two standard errors passes a little more often than one look would; they can only keep
    a plan from being dropped, and never change the settings for less than the rule above asks.

    Args:
        given: the plan with the settings as they are.
        other: the plan that may replace it; ``None`` for none.
        actor: the actor alone.
        confidence: standard errors of a difference that is no chance.

    Examples:
        >>> given = Finalist((10.0, 12.0, 11.0), (0.4, 0.4, 0.4))
        >>> smooth = Finalist((10.0, 12.1, 11.0), (0.1, 0.1, 0.1), {"change_cost": 1.0})
        >>> actor = Finalist((5.0, 6.0, 7.0), (0.0, 0.0, 0.0))
        >>> choice = choose(given, smooth, actor)
        >>> choice.reason, choice.acting, choice.certain
        ('smoother', 'planner', True)
    """
    plan, reason = given, "as given"
    if other is not None:
        ahead, error = other.ahead_of(given)
        trifle = _TRIFLE * abs(sum(actor.returns) / len(actor.returns))
        allowed = max(_SHARE * given.ahead_of(actor)[0], trifle)
        if ahead > confidence * error or (given.fails and not other.fails):
            plan, reason = other, "better"
        elif ahead >= -allowed and other.smoother_than(given):
            plan, reason = other, "smoother"
    gain, error = plan.ahead_of(actor)
    acts = gain > -min(confidence, 1.0) * error or (gain >= 0.0 and plan.smoother_than(actor))
    certain = abs(gain) > confidence * error or gain == error == 0.0
    return Choice(plan, reason, "planner" if acts else "actor", certain, gain, error)


def stretches(length: float, steps: int) -> float:
    """How many stretches of ``steps`` the second half of an episode has, one at least.

    Examples:
        >>> stretches(200.0, 20), stretches(200.0, 150)
        (5.0, 1.0)
    """
    return max(1.0, length / 2 / steps)


def late_weight(differences: Tensor, most: float) -> float:
    """How often late differences count: ``most``, if their noise then is not above the others'.

    Where a balance is held, a late stretch has next to no noise and tells what a plan gains or
    spoils by and by. Where episodes end at a goal, it would drown the rest.

    Args:
        differences: from the task's starts, and of late stretches, ``[2, episodes]``.
        most: how many such stretches an episode has.

    Examples:
        >>> late_weight(torch.tensor([[0.0, 4.0], [0.0, 1.0]]), 10.0)
        4.0
    """
    own, late = differences.std(-1).tolist()
    if not math.isfinite(own + late) or late * most <= own:
        return most
    return max(1.0, own / late)


def estimate(differences: Tensor) -> tuple[float, float]:
    """Sum of the means of rows ``[sorts, episodes]``, and its standard error.

    It is minus infinity where a difference is not finite.
    """
    if not differences.isfinite().all():
        return -math.inf, 0.0
    variance = differences.var(-1).sum() / differences.shape[-1]
    return differences.mean(-1).sum().item(), variance.sqrt().item()
