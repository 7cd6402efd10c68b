"""When learning in imagination has come to its end: a plateau of imagined returns, and the rates.

Late gains come as learning rates fall. So a plateau does not stop learning at once: the rates fall
first, over a short tail, and learning stops when that is over. In the same way rates do not fall,
and learning does not end, while returns still rise fast.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from phihp_torchrl.agents import learning_rate_scale
from phihp_torchrl.trainers.floor import Floor

_log = logging.getLogger(__name__)

# A rise counts if the paired starts show it beyond noise, in standard errors of their mean
# difference, and if it is more than this share of all that has been gained since the first actor.
_STANDARD_ERRORS, _SHARE = 2.0, 0.001
# Before this share of the starts has left the floor, returns that stand still are no plateau.
_AT_FLOOR = 0.15
# Returns still rise fast if in this share of the updates they have gained more than this share of
# all that has been gained since the first actor.
_LATELY, _FAST = 0.125, 0.05


class Schedule:
    """The end of learning and the factor on learning rates, which both may come early or late.

    Args:
        updates: updates in all.
        decay: share of them, at the end, over which the factor falls to a twentieth.

    Examples:
        >>> schedule = Schedule(updates=1000, decay=0.5)
        >>> schedule.scale(250), schedule.end
        (1.0, 1000)
        >>> schedule.land(300, over=200)
        >>> schedule.scale(300), round(schedule.scale(400), 3), schedule.end
        (1.0, 0.525, 500)
    """

    def __init__(self, updates: int, decay: float) -> None:
        self.updates, self.decay = updates, decay
        self.end = updates
        """Updates after which learning ends."""
        self.later = 0
        """Updates by which the fall of the rates, and the end, are put off."""
        self.landing: int | None = None
        """Updates after which the factor began to fall early, if it did."""

    @property
    def falls(self) -> int:
        """Updates after which the rates begin to fall, unless they land earlier."""
        return self.later + round(self.updates * (1.0 - self.decay))

    def scale(self, updates: int) -> float:
        """The factor on learning rates after ``updates`` updates."""
        planned = self._planned(updates)
        if self.landing is None:
            return planned
        first = self._planned(self.landing)
        left = (self.end - updates) / max(1, self.end - self.landing)
        lowest = learning_rate_scale(0.0, 1.0)
        return min(planned, lowest + (first - lowest) * max(0.0, left))

    def land(self, updates: int, over: int) -> None:
        """Let the rates fall from now on, over so many updates, and end then."""
        self.landing = updates
        self.end = min(self.end, updates + over)

    def put_off(self, by: int) -> None:
        """Let the rates fall, and learning end, so many updates later than was planned."""
        self.later += by
        self.end += by

    def state_dict(self) -> dict[str, Any]:
        """The end, where the fall began and by how much it was put off, as numbers."""
        return {"end": self.end, "landing": self.landing, "later": self.later}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self.end, self.landing = state["end"], state["landing"]
        self.later = state.get("later", 0)  # older checkpoints put nothing off

    def _planned(self, updates: int) -> float:
        left = 1.0 - max(0, updates - self.later) / self.updates
        return learning_rate_scale(left, self.decay)


class Plateau:
    """Ends learning where the best actor's returns stand still, and prolongs it while they rise.

    Actors play from the same starts, so their returns are compared start by start: a rise is one of
    more than two standard errors of the mean difference, and of more than 0.1 % of what has been
    gained since the first actor. While more than 15 % of the starts are at the floor of returns
    (:class:`~phihp_torchrl.trainers.floor.Floor`), learning goes on, for sparse rewards are found
    late.

    Where rates are about to fall, the fall is put off by ``round_to`` updates as long as the
    returns have lately, over an eighth of the planned updates, gained more than a twentieth of all
    that has been gained, and that beyond noise.

    Args:
        schedule: the end and the learning rates, which this brings forward or puts off.
        patience: share of all updates without a rise after which the rates begin to fall.
        tail: share of all updates over which they then fall, until learning ends.
        round_to: the end is a multiple of so many updates after a plateau.
        floor: makes the floor of returns from these starts, at the first plateau.
        extension: largest share of all updates by which the end may be put off.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.dynamics import TaskWorldModel
        >>> schedule = Schedule(updates=1000, decay=0.0)
        >>> task = get_task("cartpole-swingup")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> floor = Floor(model, task.reset.sample([2]), steps=5, seed=0)
        >>> plateau = Plateau(schedule, 0.2, 0.1, round_to=100, floor=lambda: floor)
        >>> import torch
        >>> plateau.see(0, torch.zeros(2))
        >>> plateau.see(100, torch.tensor([10.0, 12.0]))
        >>> plateau.see(300, torch.tensor([10.0, 12.01]))
        >>> schedule.end
        400
    """

    def __init__(
        self,
        schedule: Schedule,
        patience: float,
        tail: float,
        *,
        round_to: int,
        floor: Callable[[], Floor],
        extension: float = 0.0,
    ) -> None:
        self.schedule, self.make_floor = schedule, floor
        self.floor: Floor | None = None
        self.patience = patience * schedule.updates
        self.tail = round_to * max(1, round(tail * schedule.updates / round_to))
        self.round_to, self.extension = round_to, extension * schedule.updates
        self.first: Tensor | None = None
        self.level: Tensor | None = None
        """Returns of the best actor when they last rose, ``[N]``."""
        self.risen = 0
        """Updates when they last rose."""
        lately = max(1, round(_LATELY * schedule.updates / round_to))
        self.lately: deque[Tensor] = deque(maxlen=1 + lately)
        """That level at the last calls, the oldest first."""

    def see(self, updates: int, returns: Tensor) -> None:
        """Take note of the returns ``[N]`` of the actor after ``updates`` updates.

        The first call has those of the untrained actor, or of a run from before plateaus were seen.
        """
        if self.level is None or self.first is None:
            self.first = self.level = returns
            self.risen = updates
            self.lately.append(returns)
            return
        rise = self._is_rise(returns)
        if rise:
            self.level, self.risen = returns, updates
        self.lately.append(self.level)
        if self.schedule.landing is None:
            if not rise and updates - self.risen >= self.patience:
                self._end(updates)
            elif self._may_put_off(updates) and self._rises_fast():
                self._put_off(updates)

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs, tensors and numbers only."""
        seen = {} if self.level is None else {"first": self.first, "level": self.level}
        return {
            **seen,
            "risen": self.risen,
            "lately": list(self.lately),
            "schedule": self.schedule.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self.first, self.level = state.get("first"), state.get("level")
        self.risen = state["risen"]
        self.lately.extend(state.get("lately", ()))  # older checkpoints have none
        self.schedule.load_state_dict(state["schedule"])

    def _is_rise(self, returns: Tensor) -> bool:
        assert self.first is not None
        assert self.level is not None
        rise = (returns - self.level).double()
        mean = rise.mean().item()
        if not math.isfinite(mean):
            return not bool(self.level.isfinite().all()) and bool(returns.isfinite().all())
        error = rise.std().item() / math.sqrt(len(rise)) if len(rise) > 1 else 0.0
        gained = (returns - self.first).double().mean().item()
        return mean > max(_STANDARD_ERRORS * error, _SHARE * gained, 0.0)

    def _may_put_off(self, updates: int) -> bool:
        """Whether rates fall before the next call, and may do so later."""
        schedule = self.schedule
        about_to_fall = schedule.falls - self.round_to < updates <= schedule.falls
        return about_to_fall and schedule.later + self.round_to <= self.extension

    def _rises_fast(self) -> bool:
        assert self.first is not None
        assert self.level is not None
        gained = (self.level - self.first).double().mean().item()
        lately = (self.level - self.lately[0]).double().mean().item()
        return lately > _FAST * gained  # false for what is not finite

    def _put_off(self, updates: int) -> None:
        if not self.schedule.later:
            _log.info(
                "Imagined returns still rise fast at update %d: learning rates fall, and learning "
                "ends, later than planned, by at most %d updates.",
                updates,
                int(self.extension),
            )
        self.schedule.put_off(self.round_to)

    def _end(self, updates: int) -> None:
        assert self.level is not None
        self.floor = self.floor or self.make_floor()
        if self.floor.share(self.level) > _AT_FLOOR:
            return
        self.schedule.land(updates, self.tail)
        _log.info(
            "Imagined returns have stood at %.4g since update %d: learning rates fall from now on, "
            "and learning ends at update %d of %d.",
            self.level.mean().item(),
            self.risen,
            self.schedule.end,
            self.schedule.updates + self.schedule.later,
        )
