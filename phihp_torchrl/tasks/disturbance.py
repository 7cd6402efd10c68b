"""An unmeasured, lasting disturbance: what an agent estimates so as to have no steady error."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError, check_positive, plain_fields
from phihp_torchrl.systems import System
from phihp_torchrl.tasks.registers import Part, Seconds


@dataclass(frozen=True)
class Disturbance:
    r"""An unmeasured drift of some states that lasts, for control without a steady error.

    A load that nobody measures and a constant that is wrong leave a steady error, since the model
    knows nothing of them. A task with a disturbance has an estimate of it in its state, and its
    model moves by

    .. math:: s_{t+1} = f(s_t, a_t) + \Delta t \, d.

    Imagined episodes draw d at random, so that actor, critics and planner know what to do about
    each. At run time the agent estimates it from what the model predicted wrongly,

    .. math::
        \hat d \leftarrow \hat d + \frac{1 - e^{-\Delta t / T}}{\Delta t} \,
        (s_{t+1} - f(s_t, a_t) - \Delta t \, \hat d),

    where T is ``time``. Once the estimate has settled, the model stands still where the world does.
    That is how predictive control becomes free of offset (Pannocchia and Rawlings,
    https://doi.org/10.1002/aic.690490213).

    Args:
        high: by name of a state, the largest size of its drift, in its unit per second. Name the
            states on which a load acts, which for a mechanical system are velocities. Estimates are
            kept within it.
        time: time constant T of the estimate, in seconds. A smaller one is faster, and passes on
            more of the sensors' noise.

    Raises:
        ConfigError: for a number that is not positive, and without a state; the message names the
            field.

    Examples:
        >>> load = Disturbance(high={"speed": 20.0})
        >>> round(load.gain(0.02), 3)  # of an error, in steps of 20 ms
        0.095
    """

    high: Mapping[str, float] = field(hash=False)
    time: float = 0.2

    def __post_init__(self) -> None:
        plain_fields(self)
        check_positive(self, "time")
        if not isinstance(self.high, Mapping) or not self.high:
            raise ConfigError("high", f"expected drifts by name of a state, got {self.high!r}.")
        for name, value in self.high.items():
            if not isinstance(value, (int, float)) or not 0 < value < math.inf:
                raise ConfigError(f"high.{name}", f"expected a positive number, got {value!r}.")
        object.__setattr__(self, "high", {name: float(v) for name, v in self.high.items()})

    def check(self, system: System) -> None:
        """Refuse a name that is not a state of the system.

        Raises:
            ConfigError: naming it and the states.
        """
        if unknown := sorted(set(self.high) - set(system.state_names)):
            raise ConfigError(
                "disturbance.high",
                f"unknown {unknown}, expected some of the states {list(system.state_names)}.",
            )

    @property
    def config(self) -> dict[str, Any]:
        """Its numbers, as plain values."""
        return {"high": dict(self.high), "time": self.time}

    def gain(self, time_step: float) -> float:
        """The share of an error that one step of ``time_step`` seconds corrects."""
        return -math.expm1(-time_step / self.time)


class DisturbancePart(Part):
    """The drift of each named state as registers, which stay as they are.

    Args:
        disturbance: the disturbance.
        system: the system, for the order of its states.

    Examples:
        >>> from phihp_torchrl.systems import Pendulum
        >>> part = DisturbancePart(Disturbance(high={"theta_dot": 0.5}), Pendulum())
        >>> part.drift(torch.tensor([0.2]))
        tensor([0.0000, 0.2000])
    """

    name = "disturbance"

    def __init__(self, disturbance: Disturbance, system: System) -> None:
        self.disturbance = disturbance
        self._names = system.state_names
        self._high = [disturbance.high[name] for name in self._names if name in disturbance.high]
        self.indices = [i for i, name in enumerate(self._names) if name in disturbance.high]
        """The disturbed components of the state."""

    @property
    def size(self) -> int:
        return len(self.indices)

    def scales(self) -> tuple[Tensor, Tensor]:
        high = torch.tensor(self._high)
        return torch.zeros_like(high), high

    def rest(self, command: Tensor) -> Tensor:
        return torch.zeros_like(command[..., :1]).expand(*command.shape[:-1], self.size)

    def random(self, commands: Tensor, generator: torch.Generator | None = None) -> Tensor:
        device = torch.device("cpu") if generator is None else generator.device
        shape = [*commands.shape[:-2], self.size]
        unit = 2.0 * torch.rand(shape, generator=generator, device=device) - 1.0
        return commands.new_tensor(self._high) * unit.to(commands)

    def step(self, registers: Tensor, command: Tensor, time_step: Seconds) -> tuple[Tensor, Tensor]:
        return command, registers

    def drift(self, registers: Tensor) -> Tensor:
        """The drift of the state, ``[*batch, n]`` per second."""
        still = torch.zeros_like(registers[..., 0])
        columns = dict(zip(self.indices, registers.unbind(-1), strict=True))
        return torch.stack([columns.get(i, still) for i in range(len(self._names))], -1)

    def corrected(self, registers: Tensor, error: Tensor, time_step: float) -> Tensor:
        """The estimate ``[*batch, size]`` after a step whose end was predicted with an error.

        Args:
            registers: the estimate with which it was predicted.
            error: the state after the step less its prediction, ``[*batch, n]``.
            time_step: seconds of the step.
        """
        gain = self.disturbance.gain(time_step) / time_step
        high = registers.new_tensor(self._high)
        return (registers + gain * error[..., self.indices]).clamp(-high, high)
