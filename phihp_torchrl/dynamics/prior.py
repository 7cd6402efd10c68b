"""F^p as a module: the equations with learnable constants, and the whole truth for comparison."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from phihp_torchrl.systems import System


class PhysicsPrior(nn.Module):
    """F^p(s, a; theta_p): a system's frictionless equations, constants learned from a first guess.

    Constants are kept as logarithms, so they stay positive and a step changes them by a ratio.

    Args:
        system: whose equations these are. Its friction is never read.
        constants: first guess by name; absent ones start at the system's declared values.
        learnable: whether the constants are parameters (else buffers).

    Raises:
        ValueError: for an unknown constant or one that is not positive.

    Examples:
        >>> from phihp_torchrl.systems import Pendulum
        >>> prior = PhysicsPrior(Pendulum(), constants={"mass": 1.3})
        >>> round(prior.constants()["mass"].item(), 3)
        1.3
        >>> prior(torch.zeros(4, 2), torch.zeros(4, 1)).shape
        torch.Size([4, 2])
    """

    def __init__(
        self,
        system: System,
        constants: Mapping[str, float] | None = None,
        learnable: bool = True,
    ) -> None:
        super().__init__()
        guess = type(system)(constants={**system.constants, **(constants or {})}).constants
        self.system = system
        self.names = tuple(guess)
        logarithms = torch.tensor([guess[name] for name in self.names]).log()
        if learnable:
            self.log_constants = nn.Parameter(logarithms)
        else:
            self.register_buffer("log_constants", logarithms)

    def constants(self) -> dict[str, Tensor]:
        """The constants as they are now, by name, each a scalar."""
        return dict(zip(self.names, self.log_constants.exp().unbind(), strict=True))

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """ds/dt without friction: ``[*batch, n], [*batch, m] -> [*batch, n]``."""
        return self.system.prior(state, action, self.constants())


class WorldPhysics(nn.Module):
    """The true ds/dt, friction and all: what an oracle plans with and the simulated world runs on.

    Args:
        system: the world's system.
    """

    def __init__(self, system: System) -> None:
        super().__init__()
        self.system = system

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """ds/dt: ``[*batch, n], [*batch, m] -> [*batch, n]``."""
        return self.system.derivative(state, action)


def perturbed_constants(
    system: System, error: float, generator: torch.Generator | None = None
) -> dict[str, float]:
    """A first guess of the constants: each ``1 ± error`` times the truth, the sign drawn at random.

    Args:
        system: whose constants to perturb.
        error: relative error, in [0, 1).
        generator: source of the signs.

    Raises:
        ValueError: if ``error`` is outside [0, 1).

    Examples:
        >>> from phihp_torchrl.systems import Pendulum
        >>> sorted(perturbed_constants(Pendulum(), error=0.0).items())
        [('gravity', 10.0), ('length', 1.0), ('mass', 1.0)]
    """
    if not 0 <= error < 1:
        raise ValueError(f"error: expected a relative error in [0, 1), got {error}.")
    signs = torch.randint(0, 2, (len(system.constants),), generator=generator).tolist()
    return {
        name: value * (1 + error if sign else 1 - error)
        for (name, value), sign in zip(system.constants.items(), signs, strict=True)
    }
