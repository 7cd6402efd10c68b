"""Start states from a box that grows from the goal outwards: a reversed curriculum."""

from __future__ import annotations

from phihp_torchrl.imagination.box_states import BoxStates
from phihp_torchrl.tasks import Box


class GrowingStates(BoxStates):
    """Start states from a box around the goal that grows to a wide one as training goes on.

    From near the goal a sparse reward is met; what has been learned there is met from a little
    further away. So the way back from the goal is learned piece by piece (Florensa et al., 2017,
    https://arxiv.org/abs/1707.05300, who let success decide how fast; here time does).

    Args:
        goal: the box at first.
        wide: the box at last.
        growth: share of the training after which it is the wide one, in (0, 1].

    Examples:
        >>> states = GrowingStates(Box((-1.0,), (1.0,)), Box((-3.0,), (5.0,)), growth=0.5)
        >>> states.grow(0.25)
        >>> states.box.low, states.box.high
        ((-2.0,), (3.0,))
    """

    def __init__(self, goal: Box, wide: Box, growth: float) -> None:
        super().__init__(goal)
        self.goal, self.wide, self.growth = goal, wide, growth

    def grow(self, progress: float) -> None:
        """Set the box for a share of the training in [0, 1]."""
        way = min(1.0, progress / self.growth)
        self.box = Box(
            *(
                tuple(a + way * (b - a) for a, b in zip(near, far, strict=True))
                for near, far in ((self.goal.low, self.wide.low), (self.goal.high, self.wide.high))
            )
        )
