"""PID control of chosen components of the state, tuned from a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from phihp_torchrl.baselines.controller import Controller
from phihp_torchrl.baselines.point import LinearModel, half_ranges, is_smooth, linearise
from phihp_torchrl.baselines.reference import followed, middle, present
from phihp_torchrl.baselines.tuning import Gains, pair, tune
from phihp_torchrl.config import LARGEST_FLOAT32, ConfigError, plain
from phihp_torchrl.tasks import Task


class PID(Controller):
    r"""One PID loop for each action, from one component of the state to its set point.

    .. math:: u = u_0 + k_p e + k_i \int e\,dt - k_d \dot y, \qquad e = r - y

    The derivative acts on the component's own velocity, which the state has, so that set points
    may jump; a component without one gets a PI controller. The integral stands still while the
    action is on a bound and the error would drive it further (conditional integration).

    Where the task has a reference of components of the state, it is the set point of their loops.

    Loops are tuned one by one, from the linear model at the set point (:meth:`from_model`). They
    ignore one another, and every component that has no loop: a PID on a pole does not keep its
    cart in place. Dead time and lag of an actuator are in the model that tunes the loops, but where
    it has a dead zone or a slew limit, it is left out.

    Args:
        point: the linear model, whose state has the set points.
        gains: gains by name of the action; an action without a loop keeps its value of the point.
        components: component by name of the action.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> pid = PID.from_model(task, HybridDynamics.pure_prior(task))
        >>> pid.components
        {'torque': 'theta'}
        >>> leaning = TensorDict(observation=task.observe(torch.tensor([0.01, 0.0])))
        >>> bool(pid(leaning)["action"] < 0)
        True
    """

    def __init__(
        self, point: LinearModel, gains: Mapping[str, Gains], components: Mapping[str, str]
    ) -> None:
        super().__init__(point.task)
        self.point, self.gains, self.components = point, dict(gains), dict(components)
        system = point.task.system
        names = system.state_names
        self._loops = []
        for action, component in self.components.items():
            velocity = system.velocity_of.get(component)
            self._loops.append(
                (
                    system.action_names.index(action),
                    names.index(component),
                    None if velocity is None else names.index(velocity),
                    self.gains[action],
                )
            )
        self._integral: Tensor | None = None
        self._followed = followed(point.task)

    @property
    def dynamics(self) -> nn.Module | None:
        """The model that it was made in, if it is known."""
        return self.point.dynamics

    @classmethod
    def from_model(
        cls,
        task: Task,
        dynamics: nn.Module,
        *,
        goal: Sequence[float] | None = None,
        components: Mapping[str, str] | None = None,
        time_constant: float | None = None,
    ) -> PID:
        """Tune it in a model.

        Args:
            task: the task.
            dynamics: the model, ``(state, action) -> next state``.
            goal: the state with the set points. Defaults to the task's goal; for a task with a
                reference to the middle of that, with the other components at which the model rests
                there, sought from the middle of the wide box.
            components: component of the state by name of the action. By default each action has
                the one that it moves most, in units of the half-range of the task's wide box, of
                those of the reference if there is one.
            time_constant: λ of all loops, in seconds; by default the shortest robust one.

        Raises:
            ConfigError: for an unknown name, a time constant that is no positive number, where the
                task has no goal, and where no gains give a stable loop; the message names the
                component.
        """
        if time_constant is not None:
            time_constant = _positive("time_constant", time_constant)
        follows = list(followed(task))
        if follows and goal is None:
            goal = middle(task)
        point = linearise(task, dynamics, goal, registers=is_smooth(task), follows=follows)
        if components is None:
            components = pair(point, half_ranges(task)[0].numpy(), follows or None)
            if not components:
                raise ConfigError("components", "expected some that an action moves, got none.")
        known = (("components", components, task.system.action_names),
                 ("components", components.values(), task.system.state_names))  # fmt: skip
        for key, names, expected in known:
            if unknown := sorted(set(names) - set(expected)):
                raise ConfigError(key, f"unknown {unknown}, expected some of {expected}.")
        gains = {
            action: tune(point, component, action, time_constant)
            for action, component in components.items()
        }
        return cls(point, gains, components)

    def act(self, state: Tensor, starts: Tensor | None = None) -> Tensor:
        physical, registers = self.task.split(state)
        at = self.point.state[: physical.shape[-1]].to(state)
        if self._followed:
            at = at.expand_as(physical).clone()
            at[..., list(self._followed.values())] = present(self.task, registers)
        error = -self.task.system.difference(physical, at)
        action = self.point.action.to(state).expand(*state.shape[:-1], -1)
        sums = self._recall(error, starts)
        wanted, rates = list(action.unbind(-1)), []
        for k, (u, y, v, gains) in enumerate(self._loops):
            part = wanted[u] + gains.p * error[..., y] + sums[..., k]
            wanted[u] = part if v is None else part + gains.d * error[..., v]
            rates.append(gains.i * error[..., y] * self.task.time_step)
        action = torch.stack(wanted, -1)
        over = action - self.task.clip_action(action)
        held = [
            over[..., loop[0]] * rate > 0 for loop, rate in zip(self._loops, rates, strict=True)
        ]
        pairs = zip(rates, held, sums.unbind(-1), strict=True)
        self._integral = torch.stack([torch.where(h, s, s + r) for r, h, s in pairs], -1)
        return action

    def reset(self) -> None:
        """Start the integrals from zero."""
        self._integral = None

    def _recall(self, like: Tensor, starts: Tensor | None) -> Tensor:
        """The integrals ``[*batch, loops]``; zero for a new batch and where an episode starts."""
        zero = like.new_zeros(*like.shape[:-1], len(self._loops))
        kept = self._integral
        if kept is None or kept.shape != zero.shape or kept.device != zero.device:
            return zero
        return kept if starts is None else torch.where(starts.unsqueeze(-1), zero, kept)


def _positive(key: str, value: Any) -> float:
    """A finite number above 0, also one of NumPy or torch; refuses others by the key."""
    number = plain(value)
    known = isinstance(number, (int, float)) and not isinstance(number, bool)
    if known and 0 < number <= LARGEST_FLOAT32:
        return number
    raise ConfigError(key, f"expected a positive number, got {value!r}.")
