"""What a controller refuses: observations that cannot be, and actions that must not be sent."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from phihp_torchrl.config import INFINITE, ConfigError, check_count, check_fields, check_positive
from phihp_torchrl.deployment.own_check import OwnCheck
from phihp_torchrl.tasks import LastAction, Task
from phihp_torchrl.worlds import read_guards

_log = logging.getLogger(__name__)

REASONS = {
    "observation": "an observation that is not finite",
    "implausible": "an observation outside the plausible ranges, or a cosine without its sine",
    "stale": "a sample that is too old, of another clock, or the one before once more",
    "inputs": "a reference or an input that is not finite",
    "late": "no plan by the deadline",
    "error": "a plan that raised an exception",
    "not_finite": "an action that is not finite",
    "bounds": "an action outside the task's bounds",
    "rate": "an action too far from the one before",
    "constraint": "a state, or an action, outside the task's constraints",
    "refused": "an action that the caller's own check refused",
}
"""Why another controller takes over, by the name under which it is counted."""

_ROUNDING = 1e-4
"""How far, in half-ranges, an action may be outside its bounds, where rounding put it."""


@dataclass(frozen=True)
class Safety:
    """The limits beyond which a :class:`~phihp_torchrl.deployment.Controller` is overruled.

    Args:
        deadline: seconds from the call of ``step`` within which the agent must have acted; ``None``
            to wait for it for ever. One of more than a time step is warned of.
        plausible: by name of a state, the largest ``|value|``, or the lowest and the highest value,
            that a sensor can report, in the unit of the state. States without an entry may have any
            finite value, and an infinite limit is none.
        mismatch: how much the cosine and the sine of an angle may contradict each other: the
            largest difference of an observation to the one of the state read from it. ``None`` for
            any.
        max_age: seconds after which a sample is too old to act upon; ``None`` for any age. With it,
            a time that is not a number is stale too, and one that is more than a step ahead of the
            controller's clock, for it is of another clock.
        max_change: the largest change of each action from one step to the next, in units of the
            action: one number, or one for each. ``None`` for any.
        hold_steps: steps in a row for which the last action may be held before the motor is left
            at rest.
        constraints: whether the fallback takes over in a step whose observed state, or that state
            with the agent's action, is outside the task's constraints, hard or soft. It should be a
            function that leads back, for neither the actor nor the last action needs to. A
            constraint's function that raises an error is violated; the first error is logged.

    Raises:
        ConfigError: for a value of another type, and for a number that is not positive.

    Examples:
        >>> Safety(deadline=0.015, plausible={"x": 2.0}).hold_steps
        5
    """

    deadline: float | None = None
    plausible: Mapping[str, float | tuple[float, float]] = field(
        default_factory=dict, hash=False, metadata=INFINITE
    )
    mismatch: float | None = 0.05
    max_age: float | None = None
    max_change: float | tuple[float, ...] | None = None
    hold_steps: int = 5
    constraints: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        given = [n for n in ("deadline", "mismatch", "max_age") if getattr(self, n) is not None]
        check_positive(self, *given)
        check_count(self, "hold_steps", least=0)
        if self.max_change is not None:
            change = self.max_change
            if not all(each > 0 for each in (change if isinstance(change, tuple) else (change,))):
                raise ConfigError("max_change", f"expected positive numbers, got {change!r}.")


class Checks:
    """The limits of a :class:`Safety` for one task, as functions that name what is wrong.

    Args:
        task: the task.
        safety: the limits.

    Raises:
        ConfigError: for limits that do not fit the task.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> checks = Checks(get_task("pendulum"), Safety(max_change=0.5))
        >>> checks.observation(torch.tensor([1.0, 0.0, 0.0]))
        >>> checks.observation(torch.tensor([1.0, 1.0, 0.0]))
        'implausible'
        >>> checks.action(torch.tensor([1.0]), torch.tensor([0.0]))
        'rate'
    """

    def __init__(self, task: Task, safety: Safety) -> None:
        self.task, self.safety = task, safety
        try:
            limits = read_guards(task, safety.plausible)
        except ConfigError as error:
            raise ConfigError(error.key.replace("guards", "plausible", 1), error.reason) from error
        if safety.constraints and not task.constraints:
            raise ConfigError(
                "constraints", f"expected a task with constraints, {task.name!r} has none."
            )
        if safety.deadline is not None and safety.deadline > task.time_step:
            _log.warning(
                "deadline: %g s is more than the time step of task %r, %g s, so a late action may "
                "hold up the loop; it is in seconds.",
                safety.deadline,
                task.name,
                task.time_step,
            )
        names = task.system.state_names
        self._limited = [names.index(name) for name in limits]
        self._low = torch.tensor([low for low, _ in limits.values()])
        self._high = torch.tensor([high for _, high in limits.values()])
        self._bounds = task.bounds
        self.rest = task.clip_action(torch.zeros(task.action_dim))
        change = safety.max_change
        if isinstance(change, tuple) and len(change) != task.action_dim:
            raise ConfigError(
                "max_change",
                f"expected one number, or one for each of {task.system.action_names}, "
                f"got {change!r}.",
            )
        self.change = None if change is None else torch.tensor(change).expand(task.action_dim)
        self._keeps = OwnCheck("A constraint of the task", self._keeps_constraints)
        self._rate = LastAction(task.bounds, rate_limit=task.action_rate_limit, cost=0.0)

    def command(self, action: Tensor, last: Tensor) -> Tensor:
        """The command for an action ``[m]``: in the task's bounds, and within its rate."""
        return self._rate.limit(last, self.task.clip_action(action), self.task.time_step)

    def observation(self, observation: Tensor) -> str | None:
        """Why an observation ``[o]`` on the CPU cannot be acted upon, or ``None``."""
        if not observation.isfinite().all():
            return "observation"
        seen = observation[: self.task.system.observation_dim]
        if not self._limited and self.safety.mismatch is None:
            return None
        state = self.task.system.locate(seen)
        if self.safety.mismatch is not None:
            off = (self.task.system.observe(state) - seen).abs()
            if (off > self.safety.mismatch * (1.0 + seen.abs())).any():
                return "implausible"
        limited = state[self._limited]
        outside = (limited < self._low) | (limited > self._high)
        return "implausible" if outside.any() else None

    def action(self, action: Tensor, last: Tensor) -> str | None:
        """Why an action ``[m]`` on the CPU must not follow the one before, or ``None``."""
        if not action.isfinite().all():
            return "not_finite"
        low, high, _, scale = self._bounds
        if ((action < low - _ROUNDING * scale) | (action > high + _ROUNDING * scale)).any():
            return "bounds"
        change = (self.command(action, last) - last).abs()
        too_far = self.change is not None and change > self.change + _ROUNDING * scale
        return "rate" if too_far is not False and too_far.any() else None

    def violates(self, observation: Tensor, action: Tensor) -> bool:
        """Whether an observation ``[o]``, or it and an action ``[m]``, violate a constraint.

        A constraint whose function raises an error is violated.
        """
        return self.safety.constraints and not self._keeps(observation, action)

    def towards_rest(self, last: Tensor) -> Tensor:
        """The action ``[m]`` nearest to rest (zero, in bounds) that may follow the last one."""
        rest = self.command(self.rest, last)
        if self.change is None:
            return rest
        return last + (rest - last).clamp(-self.change, self.change)

    def _keeps_constraints(self, observation: Tensor, action: Tensor) -> Tensor:
        state = self.task.system.locate(observation[: self.task.system.observation_dim])
        command = self.task.clip_action(action)
        return ~(self.task.limits.violations(state, command) > 0).any()
