"""Where a task wants its system to stay, and the linear model around that state."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.func import jacfwd

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import DisturbancePart, SignalPart, Step, Task

Matrix = NDArray[np.float64]

_SECANT = 0.05
"""Half-ranges to either side of the goal across which slopes of the state are taken."""
DRIFT = 0.01
"""The largest motion in one step, in half-ranges of the state, of what counts as a rest."""
_STILL = 1e-12
"""The motion below which a rest is not sought any better."""
_SAMPLES = 512
"""States of the wide box whose rewards are compared with that of a goal."""
_TRIED = 8
"""Of these, the states near which a rest is sought where the middle of the box is none."""


@dataclass(frozen=True)
class LinearModel:
    """A task's one step around a state at rest: ``z[k+1] = A z[k] + B u[k]``.

    ``z`` is the difference to the point's state, of angles on the circle, and ``u`` that to its
    action. ``z`` has the registers of the task that an action moves too, unless they were left out.

    Args:
        task: the task.
        state: the state at rest, float64 ``[n]``, of the components of ``z``.
        action: the action that keeps it there, float64 ``[m]``.
        a: the matrix A, ``[n, n]``.
        b: the matrix B, ``[n, m]``.
        moved: the registers in ``z``, by their places among those of the task.
        dynamics: the model that was linearised, if it is known.
    """

    task: Task
    state: Tensor
    action: Tensor
    a: Matrix
    b: Matrix
    moved: tuple[int, ...] = ()
    dynamics: nn.Module | None = None

    def difference(self, state: Tensor, at: Tensor | None = None) -> Tensor:
        """``z`` of a state, in its dtype and on its device.

        Args:
            state: states of the task, ``[*batch, N]``.
            at: states of the task in place of the point's, ``[*batch, N]``.
        """
        own = self._own(state)
        at = self.state.to(state) if at is None else self._own(at)
        size = self.task.system.state_dim
        delta = self.task.system.difference(own[..., :size], at[..., :size])
        if not self.moved:
            return delta
        return torch.cat([delta, own[..., size:] - at[..., size:]], -1)

    def _own(self, state: Tensor) -> Tensor:
        """The components of a state of the task that ``z`` has."""
        physical, registers = self.task.split(state)
        if not self.moved:
            return physical
        return torch.cat([physical, registers[..., list(self.moved)]], -1)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the components of the state, registers by number."""
        own = self.task.system.state_names
        return (*own, *(f"register {i}" for i in range(len(self.a) - len(own))))


def physical_step(dynamics: nn.Module) -> Step:
    """The step of a model for what acts on the system, without clipping."""
    return getattr(dynamics, "step", dynamics)


def exact_step(dynamics: nn.Module) -> Step:
    """The same of a copy of the model, in double precision on the CPU."""
    return physical_step(copy.deepcopy(dynamics).to(device="cpu", dtype=torch.float64))


def is_smooth(task: Task) -> bool:
    """Whether a small command has an effect in proportion, in a task's actuator."""
    numbers = {} if task.actuator is None else task.actuator.config
    return not {"dead_zone", "slew"} & set(numbers)


def half_ranges(task: Task) -> tuple[Tensor, Tensor]:
    """Half-ranges of state and action, float64 ``[n]`` and ``[m]``: the units of "large".

    Those of the state are of the task's wide box, or else of its reset box; 1 where that is a
    point.
    """
    box = task.coverage or task.reset
    half = (torch.tensor(box.high).double() - torch.tensor(box.low).double()) / 2
    return torch.where(half > 0, half, torch.ones_like(half)), task.bounds.scale.double()


def linearise(
    task: Task,
    dynamics: nn.Module,
    goal: Sequence[float] | None = None,
    *,
    registers: bool = True,
    follows: Sequence[str] = (),
) -> LinearModel:
    """The linear model of one step at the goal: derivatives by actions, secants by components.

    Args:
        task: the task.
        dynamics: the model, ``(state, action) -> next state``.
        goal: the physical state at which to linearise. Defaults to the task's goal: the centre of
            its box ``goal``, or else a state at rest whose reward no state of the wide box exceeds:
            the centre of that box or of the reset box, or a rest near states that earn most.
        registers: whether the registers that an action moves, such as commands under way and the
            last action, belong to the state. Those of a reference and of an estimated disturbance
            never do.
        follows: components that follow the task's reference, and have the values of ``goal``; the
            others are those at which the model rests there, sought from ``goal``.

    Raises:
        ConfigError: where there is no such state, or the model does not rest in it, and for a task
            with inputs, or with a reference without ``follows``, whose goal moves.
    """
    for name in ("inputs",) if follows else ("reference", "inputs"):
        if getattr(task, name) is not None:
            raise ConfigError(name, f"expected none for a fixed goal, {task.name!r} has {name}.")
    step = exact_step(dynamics)
    state, action = _rest(task, step, goal, follows)
    at, move, moved = state, step, _moved(task) if registers else ()
    if moved:
        at = torch.cat([state, task.registers.rest(action)])
        move = _with_registers(task, step)
    with torch.no_grad():
        slope_a, b = (m.detach().numpy() for m in jacfwd(move, (0, 1))(at, action))
        a = _with_secants(task, move, at, action, slope_a)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ConfigError("dynamics", "expected finite derivatives at the goal, got others.")
    size = len(state)
    kept = [*range(size), *(size + place for place in moved)]
    return LinearModel(task, at[kept], action, a[np.ix_(kept, kept)], b[kept], moved, dynamics)


def _moved(task: Task) -> tuple[int, ...]:
    """The places of the registers that actions move: all but signals and disturbances."""
    places, first = list[int](), 0
    for part, size in zip(task.registers.parts, task.registers.sizes, strict=True):
        if not isinstance(part, (SignalPart, DisturbancePart)):
            places += range(first, first + size)
        first += size
    return tuple(places)


def _with_secants(task: Task, move: Step, at: Tensor, action: Tensor, a: Matrix) -> Matrix:
    """The slopes of the physical components as secants across a share of their half-ranges.

    A residual that has learned dry friction is steep at rest, as if friction were a strong viscous
    one; its derivative there says nothing of a system that moves.
    """
    ranges, found = half_ranges(task)[0], a.copy()
    size = len(ranges)
    for i, reach in enumerate(_SECANT * ranges):
        shift = torch.zeros_like(at)
        shift[i] = reach
        ahead, behind = move(at + shift, action), move(at - shift, action)
        change = ahead - behind
        change[:size] = task.system.difference(ahead[:size], behind[:size])
        found[:, i] = (change / (2.0 * reach)).numpy()
    return found


def _with_registers(task: Task, step: Step) -> Step:
    """The step of the whole state, registers included."""

    def move(state: Tensor, action: Tensor) -> Tensor:
        physical, waiting = task.split(state)
        acting, waiting = task.acting(waiting, action)
        return torch.cat([step(physical, acting), waiting], -1)

    return move


def _rest(
    task: Task, step: Step, goal: Sequence[float] | None, follows: Sequence[str] = ()
) -> tuple[Tensor, Tensor]:
    """The goal, with what is sought in it, and the action that keeps it."""
    free = [i for i, name in enumerate(task.system.state_names) if follows and name not in follows]
    if goal is not None:
        if len(goal) != task.system.state_dim:
            raise ConfigError(
                "goal",
                f"expected {task.system.state_dim} values for {task.system.state_names}, "
                f"got {tuple(goal)}.",
            )
        places = [torch.tensor(list(goal)).double()]
    else:
        boxes = (task.goal,) if task.goal is not None else (task.coverage, task.reset)
        places = [
            (torch.tensor(box.low).double() + torch.tensor(box.high).double()) / 2
            for box in boxes
            if box is not None
        ]
    reasons = []
    sought = [(state, free) for state in places]
    if goal is None and task.goal is None and not follows:
        everywhere = list(range(task.system.state_dim))
        sought += [(state, everywhere) for state in _most_rewarded(task)]
    for state, free in sought:
        state, action, drift = trim(task, step, state, free)
        if drift > DRIFT:
            reasons.append(f"the model drifts from {_text(state)} by {drift:.2g} half-ranges")
        elif goal is None and _is_exceeded(task, state, action):
            reasons.append(f"other states earn more than {_text(state)}")
        else:
            return state, action
    raise ConfigError("goal", f"expected a state to stay in: {'; '.join(reasons)}.")


def _most_rewarded(task: Task) -> list[Tensor]:
    """The states without velocity of the wide box that earn most, without ending the episode.

    There are none where most states earn as much.
    """
    box = task.coverage or task.reset
    states = box.sample([_SAMPLES], generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    names = task.system.state_names
    states[:, [names.index(name) for name in task.system.velocity_of.values()]] = 0.0
    actions = task.bounds.center.double().expand(_SAMPLES, -1)
    with torch.no_grad():
        earned = task.reward(states, actions, states)
        over = task.is_terminated(task.at_rest(states))
    states, earned = states[~over], earned[~over]
    if not (len(earned) and earned.max() > earned.median()):
        return []
    return list(states[earned.argsort(descending=True)[:_TRIED]])


def trim(
    task: Task, step: Step, start: Tensor, free: Sequence[int] = ()
) -> tuple[Tensor, Tensor, float]:
    """A state, the action ``[m]`` that keeps it best, and how far it still moves in a step.

    Components that are ``free`` are sought with the action, from their values at the start.
    """
    ranges, _ = half_ranges(task)
    state, action, count = start, task.bounds.center.double(), len(free)
    places = torch.tensor(free, dtype=torch.long)

    def drift(sought: Tensor) -> Tensor:
        here = state.index_put((places,), sought[:count])
        return task.difference(step(here, sought[count:]), here) / ranges

    with torch.no_grad():
        for _ in range(5):
            sought = torch.cat([state[places], action])
            off = drift(sought)
            if off.abs().max() < _STILL:
                break
            slope = jacfwd(drift)(sought)
            sought = sought - torch.linalg.pinv(slope, rtol=1e-9) @ off
            state = state.index_put((places,), sought[:count])
            action = task.clip_action(sought[count:])
        left = drift(torch.cat([state[places], action])).abs().max().item()
    return state, action, left if left == left else float("inf")


def _is_exceeded(task: Task, state: Tensor, action: Tensor) -> bool:
    """Whether a state of the wide box earns more than ``state``, for the same action."""
    generator = torch.Generator().manual_seed(0)
    box = task.coverage or task.reset
    others = box.sample([_SAMPLES], generator=generator, dtype=torch.float64)
    actions = action.expand(_SAMPLES, -1)
    with torch.no_grad():
        earned = task.reward(others, actions, others)
        here = task.reward(state[None], action[None], state[None])[0]
    spread = (earned.max() - earned.min()).item()
    return bool(earned.max() > here + 1e-3 * spread)


def _text(state: Tensor) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in state.tolist()) + ")"
