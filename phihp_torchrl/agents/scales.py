"""The units in which networks read observations and learn values, measured where a task is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from phihp_torchrl.agents.equations import Layers
from phihp_torchrl.dynamics import PreparedModel, TaskWorldModel
from phihp_torchrl.imagination import StartConfig, StartStates, finite_transition, make_start_states
from phihp_torchrl.tasks import Task, Transition

# Half-ranges and values between these limits are left as they are: networks learn as well there,
# and units that are natural (radians, metres, seconds) stay what they are.
OBSERVATION_RANGE = (1 / 4, 16.0)
VALUE_RANGE = (1.0, 2048.0)
# The size that values outside the limits are brought to.
_VALUE_SIZE = 64.0
# Zero is this many half-ranges from the middle before the middle is subtracted.
_FAR = 4.0
# A range is that of the central 98 %, so that one wild sample does not set it.
_TAIL = 0.01
# States that are drawn from the coverage box, or else worlds that random actions move about.
_STATES, _WORLDS = 4096, 256
# Chance that a random action changes at a step; held ones also move slow systems.
_CHANGE = 0.1


@dataclass(frozen=True)
class Scales:
    """The units of observations and rewards in which actor and critics are trained.

    Networks read ``(observation - center) / scale`` and learn values of ``reward / reward_scale``.
    :meth:`actor` and :meth:`critics` fold these numbers into the first and last layers of trained
    networks, which then read observations and give values in physical units. So nothing else needs
    to know of them: neither planners, nor saved agents, nor exported ones.

    Scales are powers of two, by which floating-point numbers are divided without rounding.

    Args:
        center: what is subtracted from observations, ``[o]``.
        scale: the unit of observations, ``[o]``, positive.
        reward: the unit of rewards, positive.

    Examples:
        >>> scales = Scales(torch.tensor([0.0, 300.0]), torch.tensor([0.0625, 8.0]))
        >>> layers = [torch.ones(1, 2), torch.zeros(1)]
        >>> weight, bias = scales.actor(layers)
        >>> observation = torch.tensor([0.0625, 308.0])
        >>> observation @ weight.T + bias  # one unit of each
        tensor([2.])
    """

    center: Tensor
    scale: Tensor
    reward: float = 1.0

    @property
    def are_one(self) -> bool:
        """Whether they change nothing."""
        unchanged = (self.center == 0).all() and (self.scale == 1).all()
        return bool(unchanged) and self.reward == 1.0

    def actor(self, layers: Layers) -> list[Tensor]:
        """The layers of an actor that reads physical units, from those of a trained one."""
        return self._folded(layers)

    def critics(self, layers: Layers) -> list[Tensor]:
        """The stacked layers of critics in physical units, from those of trained ones."""
        return [*self._folded(layers)[:-2], *(self.reward * layer for layer in layers[-2:])]

    def _folded(self, layers: Layers) -> list[Tensor]:
        if self.are_one:
            return list(layers)
        weight, bias, *others = layers
        center, scale = (each.to(weight.device) for each in (self.center, self.scale))
        read = weight[..., : len(scale)] / scale  # critics read the action in the other columns
        shift = (read.double() @ center.double()).to(bias.dtype)
        return [torch.cat([read, weight[..., len(scale) :]], -1), bias - shift, *others]


class _InUnits:
    """What units change of a model, prepared or not, that is the next class."""

    center: Tensor
    scale: Tensor
    reward_scale: Tensor

    def locate(self, observation: Tensor) -> Tensor:
        return super().locate(observation * self.scale + self.center)  # type: ignore[misc]

    def observe(self, state: Tensor) -> Tensor:
        return (super().observe(state) - self.center) / self.scale  # type: ignore[misc]

    def transition(self, state: Tensor, action: Tensor) -> Transition:
        step = super().transition(state, action)  # type: ignore[misc]
        return step._replace(reward=step.reward / self.reward_scale)


class ScaledModel(_InUnits, TaskWorldModel):
    """A model that gives, as functions of tensors, observations and rewards in the networks' units.

    Everything that trains networks reads the model through :meth:`observe` and :meth:`transition`.
    States and actions stay in physical units.

    Args:
        model: the model.
        scales: the units.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> scales = Scales(torch.zeros(3), torch.full((3,), 2.0), reward=4.0)
        >>> model = ScaledModel(TaskWorldModel(task, HybridDynamics.hybrid(task)), scales)
        >>> model.observe(torch.zeros(2))
        tensor([0.5000, 0.0000, 0.0000])
    """

    def __init__(self, model: TaskWorldModel, scales: Scales) -> None:
        super().__init__(model.task, model.transitions)
        self.register_buffer("center", scales.center)
        self.register_buffer("scale", scales.scale)
        self.register_buffer("reward_scale", torch.tensor(scales.reward))

    def prepared(self) -> PreparedModel | TaskWorldModel:
        return _PreparedScaled(self) if self.steps_as(ScaledModel) else self


class _PreparedScaled(_InUnits, PreparedModel):
    """The same for one rollout."""

    def __init__(self, model: ScaledModel) -> None:
        super().__init__(model.task, model.transitions, model.like)
        self.center, self.scale = model.center, model.scale
        self.reward_scale = model.reward_scale

    def judge(
        self, state: Tensor, command: Tensor, next_state: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        reward, ended = super().judge(state, command, next_state)
        return reward / self.reward_scale, ended


def scaled(model: TaskWorldModel, scales: Scales) -> TaskWorldModel:
    """Return the model in these units, which is the model itself where they change nothing."""
    return model if scales.are_one else ScaledModel(model, scales)


@torch.no_grad()
def measure_scales(
    model: TaskWorldModel, states: Tensor, horizon: float, generator: torch.Generator | None = None
) -> Scales:
    """Measure the units of a task's networks from states that it visits.

    A component of the observation whose half-range lies outside ``OBSERVATION_RANGE`` is divided by
    the nearest power of two; where zero is far from its range, the middle is subtracted too. The
    cosine and the sine of an angle, and components that do not vary, are left alone. Rewards are
    divided by one if values of about ``horizon`` rewards would lie outside ``VALUE_RANGE``.

    Args:
        model: the model, for observations and rewards.
        states: states ``[N, n]``; those that are not finite are left out.
        horizon: number of rewards in a value, such as ``1 / (1 - gamma)``.
        generator: source of the random actions at which rewards are measured.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> measure_scales(model, task.coverage.sample([1000]), horizon=100.0).are_one
        True
    """
    states = states[states.isfinite().all(-1)]
    observation = model.observe(states)
    low, high = observation.quantile(_TAIL, 0), observation.quantile(1 - _TAIL, 0)
    middle, half = (low + high) / 2, (high - low) / 2
    far = (middle.abs() > _FAR * half) & (half > 0)
    free = torch.ones_like(far)
    free[_angle_columns(model.task)] = False
    smallest, largest = OBSERVATION_RANGE
    outside = (half < smallest) | (half > largest)
    vary = half > torch.finfo(half.dtype).eps * middle.abs()
    power = torch.exp2(half.log2().round())
    scale = torch.where(free & vary & (outside | far), power, 1.0)
    # A whole number of units, which is exact too.
    center = torch.where(free & vary & far, (middle / scale).round() * scale, 0.0)
    shape = [len(states), model.task.action_dim]
    unit = 2.0 * torch.rand(shape, generator=generator) - 1.0
    reward = model.transition(states, model.task.bounds.from_unit(unit)).reward
    return Scales(center, scale, _reward_scale(reward, horizon))


@torch.no_grad()
def visited_states(
    model: TaskWorldModel,
    start_states: StartStates,
    steps: int,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Draw states that a task visits, ``[N, n]``, for :func:`measure_scales`.

    They are from the task's coverage box. A task without one is explored: random actions, each held
    for a while, move many worlds of the model from where imagined episodes start.

    Args:
        model: the model.
        start_states: where imagined episodes start.
        steps: steps of such an exploration.
        generator: source of randomness.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("pendulum")
        >>> model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        >>> visited_states(model, make_start_states(task), steps=10).shape
        torch.Size([4096, 2])
    """
    task = model.task
    if task.coverage is not None:
        everywhere = StartConfig(reset=0.0, data=0.0, coverage=1.0, goal=0.0)
        return make_start_states(task, everywhere).sample([_STATES], generator)
    state = start_states.sample([_WORLDS], generator)
    action = task.bounds.center.expand(_WORLDS, task.action_dim)
    visited = [state]
    for step in range(steps):
        drawn = task.bounds.from_unit(2.0 * torch.rand(action.shape, generator=generator) - 1.0)
        changes = torch.rand(_WORLDS, 1, generator=generator) < (_CHANGE if step else 1.0)
        action = torch.where(changes, drawn, action)
        next_state, _, terminated = finite_transition(model.transition, state, action)
        restart = start_states.sample([_WORLDS], generator)
        visited.append(next_state)
        state = torch.where(terminated.unsqueeze(-1), restart, next_state)
    return torch.cat(visited)


def _reward_scale(reward: Tensor, horizon: float) -> float:
    reward = reward[reward.isfinite()].double()
    value = horizon * reward.square().mean().sqrt()
    smallest, largest = VALUE_RANGE
    if not value > 0 or smallest <= value <= largest:
        return 1.0
    return float(torch.exp2((value / _VALUE_SIZE).log2().round()))


def _angle_columns(task: Task) -> Sequence[int]:
    """The columns of the observation that are cosines and sines."""
    columns: list[int] = []
    column = 0
    for name in task.system.state_names:
        if name in task.system.angles:
            columns += [column, column + 1]
        column += 2 if name in task.system.angles else 1
    return columns
