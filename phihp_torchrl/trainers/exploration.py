"""Exploration that a plant survives: amplitude, rate, colour, a trim or a controller, guards."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from phihp_torchrl.config import (
    INFINITE,
    ConfigError,
    check_fields,
    check_not_negative,
    check_positive,
)
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.trust import CONTROLLER
from phihp_torchrl.worlds import import_object, read_guards

Controller = Callable[[Tensor], Any]
"""``observation [o] -> action [m]``, in physical units."""

_KEY = "model.collect.exploration"


@dataclass(frozen=True)
class ExplorationConfig:
    """How far, how fast and at which frequencies collection may move the action.

    The limits hold for random and for planned actions. With the defaults they limit nothing.

    Args:
        amplitude: largest distance of an action from trim or controller, in units of the action's
            half-range; 1 from the middle of the bounds is all of them.
        rate: largest change of an action, in units of its half-range per second; null for no limit.
        bandwidth: highest frequency of random actions and of the noise on planned ones, in Hz; null
            for white noise, or where colour is above 0 for all that the time step can carry.
        colour: exponent β of coloured noise, whose power falls as 1/f^β up to the bandwidth; 0 is
            flat, 1 pink, 2 red, which moves slow systems.
        trim: action of each actuator in physical units around which to explore; null for the middle
            of the bounds.
        controller: function around whose actions to explore, as module:function. It is called with
            the observation and returns the action, in physical units; one with a method reset has
            it called when an episode starts.
        guards: by name of a state, the largest absolute value, or the lowest and the highest value,
            whose crossing ends an episode.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> careful = ExplorationConfig(amplitude=0.3, rate=2.0, bandwidth=1.5, guards={"x": 0.8})
        >>> careful.limits, ExplorationConfig().limits
        (True, False)
    """

    amplitude: float = 1.0
    rate: float | None = None
    bandwidth: float | None = None
    colour: float = 0.0
    trim: tuple[float, ...] | None = None
    controller: str | None = None
    guards: Mapping[str, float | tuple[float, float]] = field(
        default_factory=dict, hash=False, metadata=INFINITE
    )

    def __post_init__(self) -> None:
        check_fields(self)
        check_not_negative(self, "colour")
        if not 0 < self.amplitude <= 2:
            raise ConfigError("amplitude", f"expected a number in (0, 2], got {self.amplitude!r}.")
        for name in ("rate", "bandwidth"):
            if getattr(self, name) is not None:
                check_positive(self, name)
        if self.controller is not None:
            if self.trim is not None:
                raise ConfigError("trim", "expected none beside a controller, which has its own.")
            module, _, function = self.controller.partition(":")
            if not (module and function):
                raise ConfigError(
                    "controller", f"expected module:function, got {self.controller!r}."
                )

    @property
    def limits(self) -> bool:
        """Whether there is something to limit an action by."""
        whole = self.amplitude == 1.0 and self.trim is None and self.controller is None
        return self.rate is not None or not whole

    @property
    def coloured(self) -> bool:
        """Whether noise is drawn as a signal of some spectrum, and not white."""
        return self.bandwidth is not None or self.colour > 0


class Exploration:
    """An :class:`ExplorationConfig` for a task: where actions may go, and the noise on them.

    Args:
        task: the task.
        config: the settings.

    Raises:
        ConfigError: for a trim, a bandwidth, a controller or guards that do not fit the task.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> careful = Exploration(get_task("pendulum"), ExplorationConfig(amplitude=0.5, rate=1.0))
        >>> start = TensorDict(observation=torch.zeros(3), step_count=torch.tensor([0]))
        >>> careful.limit(start, torch.tensor([9.0]))  # 1 half-range of 2 per second, for 0.05 s
        tensor([0.1000])
    """

    def __init__(self, task: Task, config: ExplorationConfig) -> None:
        self.task, self.config = task, config
        self._shown = task.observation_dim  # what a controller sees, whatever is appended later
        self._controller: Controller | None = None
        self._last: Tensor | None = None
        self._trim = self._read_trim()
        try:
            read_guards(task, config.guards)
        except ConfigError as error:
            raise error.inside(_KEY) from error
        if config.coloured:
            self._check_bandwidth()
        if config.controller is not None:
            self._controller = import_object(CONTROLLER, config.controller)
            if not callable(self._controller):
                raise ConfigError(CONTROLLER, f"expected a function, {config.controller} is none.")

    def base(self, tensordict: TensorDictBase) -> Tensor:
        """The action ``[m]`` around which to explore: the trim, or the controller's.

        Raises:
            ConfigError: if the controller fails, or returns no action of this task.
        """
        if self._controller is None:
            return self._trim
        key, name = CONTROLLER, self.config.controller
        if _starts(tensordict) and hasattr(self._controller, "reset"):
            self._controller.reset()
        try:
            given = self._controller(tensordict["observation"][..., : self._shown].float())
            action = torch.as_tensor(given, dtype=torch.float32)
        # A user's function may raise anything; the message should name it and the reason.
        except Exception as error:
            step = int(tensordict["step_count"])
            raise ConfigError(
                key, f"{name} failed at step {step}: {type(error).__name__}: {error}"
            ) from error
        if action.shape != self._trim.shape or not action.isfinite().all():
            raise ConfigError(
                key,
                f"expected {len(self._trim)} finite numbers of {name}, for "
                f"{list(self.task.system.action_names)}, got {given!r}.",
            )
        return self.task.clip_action(action)

    def limit(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """Bring the action ``[m]`` of this step within amplitude, bounds and rate.

        An episode starts at the action of :meth:`base`. Where the limits contradict each other,
        because a controller moves fast, the rate holds.
        """
        config = self.config
        if not config.limits:
            return action
        return self._limit(tensordict, action, self.base(tensordict))

    def around(self, tensordict: TensorDictBase, unit: Tensor) -> Tensor:
        """The limited action at ``unit`` ``[m]``, in [-1, 1], of the amplitude around the base."""
        base = self.base(tensordict)
        action = base + self.config.amplitude * self.task.bounds.scale * unit
        return self._limit(tensordict, action, base)

    def _limit(self, tensordict: TensorDictBase, action: Tensor, base: Tensor) -> Tensor:
        config, scale = self.config, self.task.bounds.scale
        reach = config.amplitude * scale
        action = self.task.clip_action(torch.clamp(action, base - reach, base + reach))
        if config.rate is not None:
            last = base if self._last is None or _starts(tensordict) else self._last
            step = config.rate * self.task.time_step * scale
            action = torch.clamp(action, last - step, last + step)
        self._last = action
        return action

    def planning_task(self) -> Task:
        """The task whose bounds are those that a plan may use.

        Around a controller, whose actions to come are not known, they are the task's.
        """
        if self._controller is not None:
            return self.task
        reach = self.config.amplitude * self.task.bounds.scale
        low = torch.maximum(self.task.bounds.low, self._trim - reach)
        high = torch.minimum(self.task.bounds.high, self._trim + reach)
        return replace(self.task, action_low=tuple(low.tolist()), action_high=tuple(high.tolist()))

    def signal(
        self, generator: torch.Generator, std: float | None = None
    ) -> Callable[[TensorDictBase], Tensor]:
        """A function that gives coloured noise ``[m]`` at each step of an episode.

        Args:
            generator: source of randomness.
            std: standard deviation of the noise; by default its largest absolute value is 1.
        """
        config, task = self.config, self.task
        values, count = torch.empty(0), 0

        def draw(tensordict: TensorDictBase) -> Tensor:
            nonlocal values, count
            if not len(values) or _starts(tensordict):
                values, count = (
                    coloured_noise(
                        task.max_steps,
                        task.action_dim,
                        task.time_step,
                        bandwidth=config.bandwidth,
                        colour=config.colour,
                        generator=generator,
                    ),
                    0,
                )
                if std is not None:
                    values = std * values / values.std(0)
            count += 1
            return values[(count - 1) % len(values)]  # the signal is periodic

        return draw

    def _read_trim(self) -> Tensor:
        task, trim = self.task, self.config.trim
        if trim is None:
            return task.bounds.center
        names = task.system.action_names
        if len(trim) != len(names):
            raise ConfigError(
                f"{_KEY}.trim", f"expected {len(names)} values for {names}, got {trim}."
            )
        values = torch.tensor(trim)
        if not ((values >= task.bounds.low) & (values <= task.bounds.high)).all():
            raise ConfigError(
                f"{_KEY}.trim",
                f"expected values within {task.action_low} and {task.action_high}, got {trim}.",
            )
        return values

    def _check_bandwidth(self) -> None:
        task, bandwidth = self.task, self.config.bandwidth
        highest, lowest = 0.5 / task.time_step, 1.0 / (task.max_steps * task.time_step)
        if not lowest <= (highest if bandwidth is None else bandwidth) <= highest:
            raise ConfigError(
                f"{_KEY}.bandwidth",
                f"expected {lowest:g} Hz, one period in an episode, to {highest:g} Hz, half the "
                f"rate of actions, got {bandwidth}.",
            )


def coloured_noise(
    length: int,
    size: int,
    time_step: float,
    *,
    bandwidth: float | None = None,
    colour: float = 0.0,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Draw a periodic signal ``[length, size]`` whose power falls as 1/f^β up to a frequency.

    It is a sum of all sines that fit into ``length`` steps, up to the bandwidth, with random phases
    and sizes (Timmer and König, 1995), so that there is no power at all above the bandwidth. Each
    column has mean 0 and a largest absolute value of 1.

    Args:
        length: number of steps.
        size: number of columns, which are independent.
        time_step: seconds of a step.
        bandwidth: highest frequency in Hz; ``None`` for half the rate of steps.
        colour: the exponent β.
        generator: source of randomness.

    Examples:
        >>> signal = coloured_noise(200, 1, 0.05, bandwidth=1.0)
        >>> signal.shape, signal.abs().max().item()
        (torch.Size([200, 1]), 1.0)
    """
    frequency = torch.fft.rfftfreq(length, time_step, dtype=torch.float64)
    # The least of rounding must not cut off the bandwidth itself.
    limit = math.inf if bandwidth is None else bandwidth * (1 + 1e-9)
    inside = (frequency > 0) & (frequency <= limit)
    size_of = torch.where(inside, frequency.clamp_min(frequency[1]) ** (-colour / 2), 0.0)
    parts = torch.randn(2, len(frequency), size, generator=generator, dtype=torch.float64)
    spectrum = size_of.unsqueeze(-1) * torch.complex(parts[0], parts[1])
    signal = torch.fft.irfft(spectrum, n=length, dim=0)
    return (signal / signal.abs().amax(0)).float()


def _starts(tensordict: TensorDictBase) -> bool:
    return int(tensordict["step_count"]) == 0
