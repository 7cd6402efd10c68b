"""F^p as a module: the equations of a system with constants that are learned."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from phihp_torchrl.config import ConfigError
from phihp_torchrl.systems import System


class PhysicsPrior(nn.Module):
    """F^p(s, a; theta_p): the known equations of a system, with constants learned from a guess.

    The parameter of a free constant is its logarithm, so that the constant stays positive and a
    step changes it by a ratio. The parameter of a bounded constant is the logit of its position
    between its limits. A fixed constant has no parameter. (Paper, section 4.1.)

    Args:
        system: the system, with its equations and the range of each constant.
        constants: first guesses by name; the others are those of the system.

    Raises:
        ConfigError: for an unknown constant, or a guess out of its limits.

    Examples:
        >>> from phihp_torchrl.systems import Pendulum
        >>> prior = PhysicsPrior(Pendulum(), constants={"mass": 1.3})
        >>> round(prior.constants()["mass"].item(), 3)
        1.3
        >>> prior(torch.zeros(4, 2), torch.zeros(4, 1)).shape
        torch.Size([4, 2])
    """

    kind = "learned"

    def __init__(self, system: System, constants: Mapping[str, float] | None = None) -> None:
        super().__init__()
        self.system = system
        self.ranges = system.with_constants(constants or {}).ranges
        self.learned = tuple(name for name, c in self.ranges.items() if not c.fixed)
        learned = [self.ranges[name] for name in self.learned]
        raw = torch.tensor([1.0 if c.bounded else c.guess for c in learned]).log()
        for i, c in enumerate(learned):
            if c.bounded:
                share = (c.guess - c.low) / (c.high - c.low)
                raw[i] = math.log(share / (1.0 - share))
        self.log_constants = nn.Parameter(raw)

    @property
    def config(self) -> dict[str, Any]:
        """Plain values from which :meth:`from_config` builds it again, without its parameters."""
        fixed = {name: c.guess for name, c in self.ranges.items() if c.fixed}
        return {"kind": self.kind, **({"fixed": fixed} if fixed else {})}

    @classmethod
    def from_config(cls, system: System, config: Mapping[str, Any]) -> PhysicsPrior:
        """Build an untrained prior from :attr:`config`."""
        return cls(system, config.get("fixed"))

    def constants(self) -> dict[str, Tensor]:
        """Return the current values of the constants by name, each a scalar."""
        return self.decode(self.log_constants)

    def decode(self, raw: Tensor) -> dict[str, Tensor]:
        """The constants that belong to parameters ``[*batch, p]``, each ``[*batch]``.

        A fixed constant is a scalar. There is one parameter for each of :attr:`learned`.
        """
        values = dict(zip(self.learned, raw.unbind(-1), strict=True))
        for name, c in self.ranges.items():
            if c.fixed:
                values[name] = raw.new_tensor(c.guess)
            elif c.bounded:
                values[name] = c.low + (c.high - c.low) * values[name].sigmoid()
            else:
                values[name] = values[name].exp()
        return {name: values[name] for name in self.ranges}

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """F^p: ``[*batch, n], [*batch, m] -> [*batch, n]``."""
        return self.system.prior(state, action, self.constants())

    def impulse(self, pair: int, state: Tensor) -> Tensor:
        """How a stop changes all velocities: see :meth:`System.impulse`, by the pair's number."""
        position = tuple(self.system.velocity_of)[pair]
        return self.system.impulse(position, state, self.constants())


def perturbed_constants(
    constants: Mapping[str, float], error: float, generator: torch.Generator | None = None
) -> dict[str, float]:
    """Make a wrong first guess of known constants: each times ``1 ± error``, with a random sign.

    Runs in simulated worlds, whose true constants are known, start from such a guess.

    Args:
        constants: true constants by name.
        error: relative error, in [0, 1).
        generator: source of the signs. Defaults to torch's global generator.

    Raises:
        ConfigError: if ``error`` is outside [0, 1).

    Examples:
        >>> perturbed_constants({"mass": 2.0}, error=0.0)
        {'mass': 2.0}
    """
    if not 0 <= error < 1:
        raise ConfigError("error", f"expected a relative error in [0, 1), got {error}.")
    signs = torch.randint(0, 2, (len(constants),), generator=generator).tolist()
    return {
        name: value * (1 + error if sign else 1 - error)
        for (name, value), sign in zip(constants.items(), signs, strict=True)
    }
