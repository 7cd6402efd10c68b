"""A system that is given by its Lagrangian in SymPy, in place of its equations of motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sympy
import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.systems.base import Constants, System
from phihp_torchrl.systems.derivation import (
    Equations,
    Mechanics,
    make_equations,
    make_symbols,
)
from phihp_torchrl.systems.names import check_names
from phihp_torchrl.systems.solve import solve_positive

Symbols = tuple[sympy.Expr, ...]
"""Symbols of a state or of an action, in the order of its names."""


class LagrangianSystem(System):
    r"""A mechanical system whose equations of motion are derived from its energies.

    .. math::
        \frac{d}{dt}\frac{\partial L}{\partial\dot q} - \frac{\partial L}{\partial q}
        = Q(q, \dot q, a)
        \quad\Longleftrightarrow\quad M(q)\,\ddot q = f(q, \dot q, a)

    A subclass declares names, angles and constants as every :class:`System` does, and implements
    :meth:`lagrangian` and, where something acts on the system, :meth:`forces`. Both are written
    with SymPy. SymPy derives M and f once, when the first system of the class is made. Their source
    is kept on disk, in the user's cache or in the folder that the environment variable
    ``PHIHP_CACHE_DIR`` names; it is Python, so nobody else should be able to write there.

    The prior solves M for the accelerations. It is a pure function as a prior by hand is: it
    compiles as one graph, differentiates, and takes any batch and dtype.

    Each component of the state is a position or the velocity of one. In the symbols of the state,
    a position is a function of time (``sympy.physics.mechanics.dynamicsymbols``) and a velocity is
    its derivative, so that frames, points and bodies of ``sympy.physics.mechanics`` can be used.

    Args:
        constants: first guesses that differ from the declared ones, by name.

    Raises:
        ConfigError: for names that do not fit together, a symbol that is none of the state, of the
            actions or of the constants, a force on what is no position, and a mass matrix that is
            not positive definite at the first guesses.

    Examples:
        >>> class Swing(LagrangianSystem):  # a mass on a string, which hangs at 0
        ...     state_names, action_names = ("angle", "speed"), ("torque",)
        ...     angles, velocity_of = ("angle",), {"angle": "speed"}
        ...     default_constants = {"mass": 1.0, "length": 2.0, "gravity": 9.81}
        ...
        ...     def lagrangian(self, state, constants):
        ...         (angle, speed), c = state, constants
        ...         kinetic = c["mass"] * (c["length"] * speed) ** 2 / 2
        ...         return kinetic + c["mass"] * c["gravity"] * c["length"] * sympy.cos(angle)
        ...
        ...     def forces(self, state, action, constants):
        ...         return {"angle": action[0]}
        >>> swing = Swing()
        >>> swing.prior(torch.zeros(2), torch.ones(1), swing.constants)
        tensor([0.0000, 0.2500])
    """

    equations: Equations

    def __init__(self, constants: Mapping[str, float] | None = None) -> None:
        super().__init__(constants)
        check_names(self)
        self.equations = make_equations(self._mechanics())
        self._check_mass()

    def lagrangian(self, state: Symbols, constants: Mapping[str, sympy.Symbol]) -> sympy.Expr:
        """Kinetic minus potential energy, as an expression.

        Args:
            state: symbols in the order of :attr:`state_names`.
            constants: symbols of the constants, by name.
        """
        raise NotImplementedError(f"{type(self).__name__}: expected a method `lagrangian`.")

    def forces(
        self, state: Symbols, action: Symbols, constants: Mapping[str, sympy.Symbol]
    ) -> Mapping[str, Any]:
        """Generalised forces by the name of the position that they act on; by default none.

        The force on a length is in N, the one on an angle in N·m: what multiplies the velocity of
        that position in the power. :mod:`~phihp_torchrl.systems.terms` has friction and stops.

        Args:
            state: symbols in the order of :attr:`state_names`.
            action: symbols in the order of :attr:`action_names`.
            constants: symbols of the constants, by name.
        """
        return {}

    def prior(self, state: Tensor, action: Tensor, constants: Constants) -> Tensor:
        mass, forcing = self._terms(state, action, constants)
        index = self.state_names.index
        rates = {name: state[..., index(velocity)] for name, velocity in self.velocity_of.items()}
        rates |= zip(self.velocity_of.values(), solve_positive(mass, forcing), strict=True)
        return torch.stack([rates[name] for name in self.state_names], -1)

    def impulse(self, position: str, state: Tensor, constants: Constants) -> Tensor:
        """A column of the inverse mass matrix, per change of the stopped position's velocity."""
        action = state.new_zeros(*state.shape[:-1], self.action_dim)
        mass, forcing = self._terms(state, action, constants)
        one, zero = torch.ones_like(forcing[0]), torch.zeros_like(forcing[0])
        blow = [one if name == position else zero for name in self.velocity_of]
        change = dict(zip(self.velocity_of, solve_positive(mass, blow), strict=True))
        parts = {v: change[q] / change[position] for q, v in self.velocity_of.items()}
        return torch.stack([parts.get(name, zero) for name in self.state_names], -1)

    def mass_matrix(self, state: Tensor, constants: Constants) -> Tensor:
        """M(q) ``[*batch, k, k]`` of the k positions, in the order of :attr:`velocity_of`.

        Args:
            state: states ``[*batch, n]``.
            constants: values of the constants, by name.
        """
        action = state.new_zeros(*state.shape[:-1], self.action_dim)
        mass, _ = self._terms(state, action, constants)
        n = len(mass)
        rows = [[mass[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def _terms(
        self, state: Tensor, action: Tensor, constants: Constants
    ) -> tuple[list[list[Tensor]], list[Tensor]]:
        """Lower triangle of the mass matrix and the forcing, each entry ``[*batch]``."""
        numbers = [_as_tensor(constants[name], state) for name in self.ranges]
        found = self.equations.function(*state.unbind(-1), *action.unbind(-1), *numbers)
        like = state[..., 0]
        entries = torch.broadcast_tensors(like, *(_as_tensor(value, state) for value in found))[1:]
        n = len(self.velocity_of)
        starts = [i * (i + 1) // 2 for i in range(n + 1)]
        mass = [list(entries[starts[i] : starts[i + 1]]) for i in range(n)]
        return mass, list(entries[starts[n] :])

    def _mechanics(self) -> Mechanics:
        state, action, numbers = make_symbols(
            self.state_names, self.velocity_of, self.action_names, tuple(self.ranges)
        )
        symbols, constants = tuple(state.values()), dict(zip(self.ranges, numbers, strict=True))
        forces = dict(self.forces(symbols, action, constants))
        if unknown := sorted(set(forces) - set(self.velocity_of)):
            raise ConfigError(
                "forces", f"unknown {unknown}, expected some of {list(self.velocity_of)}."
            )
        return Mechanics(
            lagrangian=sympy.sympify(self.lagrangian(symbols, constants)),
            forces=tuple(sympy.sympify(forces.get(name, 0)) for name in self.velocity_of),
            positions=tuple(state[name] for name in self.velocity_of),
            state=symbols,
            action=action,
            constants=numbers,
        )

    def _check_mass(self) -> None:
        generator = torch.Generator().manual_seed(0)
        state = torch.randn(16, self.state_dim, generator=generator, dtype=torch.float64)
        mass = self.mass_matrix(state, self.constants)
        if not mass.isfinite().all() or (torch.linalg.eigvalsh(mass) <= 0).any():
            raise ConfigError(
                "lagrangian",
                "expected a kinetic energy that is positive for every motion, got a mass matrix "
                f"that is not positive definite at {self.constants}. Does each of the velocities "
                f"{list(self.velocity_of.values())} have a mass, and is the potential energy "
                "subtracted from the kinetic one?",
            )


def _as_tensor(value: Any, like: Tensor) -> Tensor:
    """``value`` itself, or a number as a scalar with the dtype and the device of ``like``."""
    return value if isinstance(value, Tensor) else like.new_full((), float(value))
