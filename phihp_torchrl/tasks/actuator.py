"""What happens to a command before it acts: dead time, lag, slew, dead zone, unequal gains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.config import plain_fields
from phihp_torchrl.tasks.numbers import Numbers, check_each, one_each, read_numbers
from phihp_torchrl.tasks.registers import Seconds, follow


@dataclass(frozen=True)
class Actuator:
    r"""The path of a command ``u`` to the action that moves the system.

    A command first waits for ``delay_steps`` steps. Then a dead zone and a gain for each sign shape
    it, a slew limit bounds its rate, and a first-order lag smooths it:

    .. math:: \tau \dot y = v - y

    where v is the command after the other parts. The system moves by the mean of y over the step,
    which follows the lag to second order in the time step, and exactly where there is none.

    What is under way is kept in *registers*, which a task adds to its state
    (:attr:`~phihp_torchrl.Task.actuator`): the commands that wait, ``[ceil(delay) * m]``, the
    slewing value and the lagging value of the actions that have them. They are shifted and filtered
    once a step and never integrated, so every integrator works with them.

    Args:
        delay_steps: dead time in steps; a fraction acts during a part of the step.
        lag: time constant τ in seconds; 0 for none.
        slew: the largest rate in units of the action per second; ``None`` for no limit.
        dead_zone: commands up to this size, around zero, have no effect; larger ones lose it.
        gain_low: gain of negative commands, where that of positive ones is 1.

    Raises:
        ConfigError: for a number out of range; the message names it.

    Examples:
        >>> motor = Actuator(delay_steps=2.0, lag=0.04)
        >>> registers = motor.rest(torch.zeros(1))
        >>> registers.shape  # two commands that wait, and the lagging value
        torch.Size([3])
        >>> acting, registers = motor.step(registers, torch.ones(1), time_step=0.04)
        >>> acting, registers
        (tensor([0.]), tensor([0., 1., 0.]))
    """

    delay_steps: Numbers = 0.0
    lag: Numbers = 0.0
    slew: Numbers | None = None
    dead_zone: Numbers = 0.0
    gain_low: Numbers = 1.0

    def __post_init__(self) -> None:
        plain_fields(self)
        for f in fields(self):
            value = getattr(self, f.name)
            if f.name == "slew" and value is None:
                continue
            positive = f.name in ("slew", "gain_low")
            object.__setattr__(self, f.name, read_numbers(f.name, value, positive=positive))

    def check(self, actions: Sequence[str]) -> None:
        """Refuse numbers that are not one for all actions or one for each.

        Raises:
            ConfigError: naming the field and the actions.
        """
        for f in fields(self):
            check_each(f"actuator.{f.name}", getattr(self, f.name), actions)

    @property
    def config(self) -> dict[str, Any]:
        """The numbers that differ from those of a perfect actuator, as plain values."""
        return {f.name: v for f in fields(self) if (v := getattr(self, f.name)) != f.default}

    def _each(self, name: str, count: int) -> tuple[float, ...]:
        return one_each(getattr(self, name), count)

    def _sizes(self, count: int) -> tuple[int, list[int], list[int]]:
        """Rows of the queue, and the actions that slew and that lag."""
        depth = max(math.ceil(d) for d in self._each("delay_steps", count))
        slewing = [] if self.slew is None else list(range(count))
        lagging = [i for i, lag in enumerate(self._each("lag", count)) if lag > 0]
        return depth, slewing, lagging

    def registers(self, count: int) -> int:
        """Number of registers for ``count`` actions."""
        depth, slewing, lagging = self._sizes(count)
        return depth * count + len(slewing) + len(lagging)

    def memory(self, time_step: float) -> float:
        """Seconds after which the commands before have next to no effect: dead time and 4 lags."""
        delays, lags = (v if isinstance(v, tuple) else (v,) for v in (self.delay_steps, self.lag))
        return math.ceil(max(delays)) * time_step + 4.0 * max(lags)

    def rest(self, command: Tensor) -> Tensor:
        """Registers ``[*batch, r]`` after ``command`` ``[*batch, m]`` has been held for long."""
        depth, slewing, lagging = self._sizes(command.shape[-1])
        value = self._shape(command)
        return torch.cat([*([command] * depth), value[..., slewing], value[..., lagging]], -1)

    def random(self, commands: Tensor) -> Tensor:
        """Registers after random commands ``[*batch, k, m]``, the newest last.

        The values that slew and lag are those of the command before the ones that wait, so there
        must be :meth:`places` commands.
        """
        depth, slewing, lagging = self._sizes(commands.shape[-1])
        places = commands.shape[-2]
        value = self._shape(commands[..., places - depth - 1, :])
        queue = commands[..., places - depth :, :].flatten(-2)
        return torch.cat([queue, value[..., slewing], value[..., lagging]], -1)

    def places(self, count: int) -> int:
        """How many commands :meth:`random` needs."""
        return self._sizes(count)[0] + 1

    def scales(self, center: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Middle and half-range of each register, from those of the actions ``[m]``."""
        depth, slewing, lagging = self._sizes(len(center))
        parts = [*range(len(center))] * depth + slewing + lagging
        return center[parts], scale[parts]

    def step(self, registers: Tensor, command: Tensor, time_step: Seconds) -> tuple[Tensor, Tensor]:
        """Advance the registers by one step.

        Args:
            registers: what is under way, ``[*batch, r]``.
            command: the command of this step, in bounds, ``[*batch, m]``.
            time_step: seconds, a number or a tensor ``[*batch]``.

        Returns:
            The mean action over the step, ``[*batch, m]``, and the registers after it.
        """
        count = command.shape[-1]
        depth, slewing, lagging = self._sizes(count)
        queue = registers[..., : depth * count]
        # The waiting commands, the newest first: waited[k] is the command of k steps ago.
        rows = list(queue.unflatten(-1, (depth, count)).unbind(-2)) if depth else []
        waited = [command, *reversed(rows)]
        slews = dict(zip(slewing, registers[..., depth * count :].unbind(-1), strict=False))
        lags = registers[..., depth * count + len(slewing) :].unbind(-1)
        lagged = dict(zip(lagging, lags, strict=True))
        after = torch.cat([*rows[1:], command], -1) if depth else queue
        acting: list[Tensor] = []
        slewed, last = [], []
        for i in range(count):
            parts = self._segments(i, count, waited)
            mean = torch.zeros_like(command[..., 0])
            for share, value in parts:
                seconds = share * time_step
                if i in slews:
                    value, slews[i] = _slew(slews[i], value, self._each("slew", count)[i], seconds)
                if i in lagged:
                    value, lagged[i] = _lag(lagged[i], value, self._each("lag", count)[i], seconds)
                mean = mean + share * value
            acting.append(mean)
            slewed += [slews[i]] if i in slews else []
            last += [lagged[i]] if i in lagged else []
        following = [after, *(x.unsqueeze(-1) for x in [*slewed, *last])]
        return torch.stack(acting, -1), torch.cat(following, -1)

    def along(self, commands: Tensor, intervals: Seconds) -> tuple[Tensor, Tensor]:
        """Follow the commands of an episode, which starts with nothing under way.

        Args:
            commands: the commands in bounds, ``[T, m]``.
            intervals: seconds for which each is held, a number or ``[T]``.

        Returns:
            The mean action over each step, ``[T, m]``, and the registers before it, ``[T, r]``.
        """
        return follow(self.step, self.rest(torch.zeros_like(commands[0])), commands, intervals)

    def _segments(self, i: int, count: int, waited: list[Tensor]) -> list[tuple[float, Tensor]]:
        """The shares of a step, in order, and the shaped command that arrives during each."""
        delay = self._each("delay_steps", count)[i]
        whole = math.floor(delay)
        part = delay - whole
        segments = [(part, waited[whole + 1])] if part else []
        segments.append((1.0 - part, waited[whole]))
        return [(share, self._shape(value)[..., i]) for share, value in segments]

    def _shape(self, command: Tensor) -> Tensor:
        """Dead zone and gains of ``command`` ``[*batch, m]``."""
        columns = []
        count = command.shape[-1]
        zones, gains = self._each("dead_zone", count), self._each("gain_low", count)
        for value, zone, gain in zip(command.unbind(-1), zones, gains, strict=True):
            if zone:
                value = value - value.clamp(-zone, zone)
            columns.append(value if gain == 1.0 else torch.where(value < 0, gain * value, value))
        return torch.stack(columns, -1)


def _slew(value: Tensor, target: Tensor, rate: float, seconds: Seconds) -> tuple[Tensor, Tensor]:
    """Mean and last value of a value that moves to ``target`` at ``rate`` for ``seconds``."""
    gap = target - value
    reach = rate * seconds
    moved = torch.minimum(gap.abs(), torch.as_tensor(reach, dtype=gap.dtype, device=gap.device))
    last = value + gap.sign() * moved
    # It is on its way for moved / rate seconds, and at the target for the rest.
    mean = last - gap.sign() * moved.square() / (2.0 * reach)
    return mean, last


def _lag(value: Tensor, target: Tensor, constant: float, seconds: Seconds) -> tuple[Tensor, Tensor]:
    """Mean and last value of the lag ``constant * y' = target - y`` after ``seconds``."""
    ratio = torch.as_tensor(seconds, dtype=value.dtype, device=value.device) / constant
    gap = value - target
    return target - gap * torch.expm1(-ratio) / ratio, target + gap * torch.exp(-ratio)
