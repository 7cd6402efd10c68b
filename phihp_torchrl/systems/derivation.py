"""From a Lagrangian in SymPy to the source of a function on tensors, kept in a cache on disk."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import platformdirs
import sympy
from sympy.core.function import AppliedUndef
from sympy.printing.pytorch import TorchPrinter

from phihp_torchrl.config import ConfigError

_log = logging.getLogger(__name__)

CACHE_VARIABLE = "PHIHP_CACHE_DIR"
"""The environment variable that names another folder for the cache."""


@dataclass(frozen=True)
class Mechanics:
    """A Lagrangian and generalised forces as SymPy expressions, with the symbols in them.

    Args:
        lagrangian: L(q, q̇), kinetic minus potential energy.
        forces: the generalised force on each coordinate, in the order of ``positions``.
        positions: the coordinates q(t).
        state: symbols of the state, in its order: a coordinate, or its derivative in time.
        action: symbols of the actions.
        constants: symbols of the constants.
    """

    lagrangian: sympy.Expr
    forces: tuple[sympy.Expr, ...]
    positions: tuple[sympy.Expr, ...]
    state: tuple[sympy.Expr, ...]
    action: tuple[sympy.Symbol, ...]
    constants: tuple[sympy.Symbol, ...]

    def __post_init__(self) -> None:
        self._check("lagrangian", self.lagrangian, {*self.state, *self.constants})
        for force in self.forces:
            self._check("forces", force, {*self.state, *self.action, *self.constants})

    def _check(self, what: str, expression: sympy.Expr, known: set[sympy.Expr]) -> None:
        rates = expression.atoms(sympy.Derivative) - known  # such as accelerations
        left = expression.xreplace({part: sympy.Integer(1) for part in (*rates, *known)})
        if unknown := {*rates, *left.free_symbols, *left.atoms(AppliedUndef)}:
            raise ConfigError(
                what,
                f"unknown {sorted(map(str, unknown))}, expected an expression of nothing but the "
                "symbols that the method is given.",
            )

    @property
    def key(self) -> str:
        """A hash of the expressions, of SymPy's version and of the code of this file."""
        parts = [self.lagrangian, *self.forces, *self.positions, *self.state, *self.action]
        text = [sympy.srepr(part) for part in (*parts, *self.constants)]
        code = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
        return hashlib.sha256(json.dumps([sympy.__version__, code, *text]).encode()).hexdigest()

    def derive(self) -> str:
        """Derive Lagrange's equations, and return the source of :attr:`Equations.function`.

        SymPy's own ``lambdify`` goes the same way, by ``cse`` and the printer for torch; here the
        source is kept, and what that printer cannot yet print is printed.
        """
        from sympy.physics.mechanics import LagrangesMethod  # half a second, and seldom needed

        method = LagrangesMethod(self.lagrangian, list(self.positions))
        method.form_lagranges_equations()
        n = len(self.positions)
        mass, forcing = method.mass_matrix, method.forcing
        results = [mass[i, j] for i in range(n) for j in range(i + 1)]
        results += [forcing[i] + force for i, force in enumerate(self.forces)]
        groups = (("s", self.state), ("a", self.action), ("c", self.constants))
        names = {x: sympy.Symbol(f"{g}{i}") for g, xs in groups for i, x in enumerate(xs)}
        shared, last = sympy.cse(
            [_as_numbers(result.xreplace(names)) for result in results],
            symbols=sympy.numbered_symbols("t"),
        )
        show = _Printer({"fully_qualified_modules": True}).doprint
        return "\n".join(
            [
                "import torch",
                f"def equations({', '.join(str(name) for name in names.values())}):",
                *(f"    {name} = {show(value)}" for name, value in shared),
                f"    return [{', '.join(show(value) for value in last)}]\n",
            ]
        )


class Equations:
    """Generated equations, which copy and pickle as their source.

    Args:
        source: what :meth:`Mechanics.derive` returned.
    """

    def __init__(self, source: str) -> None:
        namespace: dict[str, Any] = {}
        exec(compile(source, "<Lagrange's equations>", "exec"), namespace)
        self.source = source
        self.function: Callable[..., list[Any]] = namespace["equations"]
        """Lower triangle of the mass matrix row by row, then the forcing: tensors or numbers."""

    def __reduce__(self) -> tuple[type[Equations], tuple[str]]:
        return Equations, (self.source,)


_MADE: dict[str, Equations] = {}


def make_equations(mechanics: Mechanics) -> Equations:
    """Return the equations of that Lagrangian: made before, from the cache on disk, or derived."""
    key = mechanics.key
    if key not in _MADE:
        path = cache_dir() / f"{key}.txt"
        source = _read(path)
        if source is None:
            source = mechanics.derive()
            _write(path, source)
        _MADE[key] = Equations(source)
    return _MADE[key]


def cache_dir() -> Path:
    """The folder of the cache: ``$PHIHP_CACHE_DIR/systems``, or one of the user's."""
    root = os.environ.get(CACHE_VARIABLE)
    return Path(root or platformdirs.user_cache_path("phihp_torchrl")).expanduser() / "systems"


def _read(path: Path) -> str | None:
    """The source in a file of the cache; ``None`` for one that is not there or not whole."""
    try:
        digest, _, source = path.read_text(encoding="utf-8").partition("\n")
    except (OSError, UnicodeDecodeError):
        return None
    return source if digest == _digest(source) else None


def _write(path: Path, source: str) -> None:
    """Write a file of the cache at once, so that another process never reads a part of it."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(f"{_digest(source)}\n{source}")
        os.replace(name, path)
    except OSError as error:
        _log.warning(
            "The equations of a Lagrangian are not kept (%s), so that every process derives them "
            "again. Set %s to a folder that can be written.",
            error,
            CACHE_VARIABLE,
        )


def _digest(source: str) -> str:
    return hashlib.sha256(source.encode()).hexdigest()


def _as_numbers(expression: sympy.Expr) -> sympy.Expr:
    """Evaluate what holds no symbol, such as sqrt(2): torch's functions take tensors alone."""
    return expression.rewrite(sympy.Heaviside, sympy.Piecewise).replace(
        lambda part: part.is_number and not part.is_Number and not part.is_Boolean,
        lambda part: part.evalf(17),
    )


class _Printer(TorchPrinter):
    """Maxima and minima of tensors and numbers, which torch has in several functions."""

    def _print_Max(self, expr: sympy.Max) -> str:
        return self._print_extremum(expr, "maximum", "min")

    def _print_Min(self, expr: sympy.Min) -> str:
        return self._print_extremum(expr, "minimum", "max")

    def _print_extremum(self, expr: sympy.Expr, function: str, limit: str) -> str:
        tensors = [self._print(argument) for argument in expr.args if not argument.is_number]
        found = reduce(lambda one, other: f"torch.{function}({one}, {other})", tensors)
        for number in (argument for argument in expr.args if argument.is_number):
            found = f"torch.clamp({found}, {limit}={self._print(number)})"
        return str(found)


def make_symbols(
    state: Sequence[str],
    velocity_of: Mapping[str, str],
    action: Sequence[str],
    constants: Sequence[str],
) -> tuple[dict[str, sympy.Expr], tuple[sympy.Symbol, ...], tuple[sympy.Symbol, ...]]:
    """Return symbols of the state by name, in its order, of the actions and of the constants.

    Raises:
        ConfigError: for a state that does not consist of positions and their velocities, and for
            a name that stands for two things.
    """
    from sympy.physics.vector import dynamicsymbols

    names = [*state, *action, *constants]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError("state_names", f"expected names that differ, got {twice} twice.")
    if sorted(state) != sorted([*velocity_of, *velocity_of.values()]):
        raise ConfigError(
            "velocity_of",
            "expected each component of the state to be a position or the velocity of one, got "
            f"{dict(velocity_of)} for {tuple(state)}.",
        )
    found = {position: dynamicsymbols(position, real=True) for position in velocity_of}
    time = dynamicsymbols._t
    found |= {velocity: found[position].diff(time) for position, velocity in velocity_of.items()}
    actions, others = (
        tuple(sympy.Symbol(name, real=True) for name in group) for group in (action, constants)
    )
    return {name: found[name] for name in state}, actions, others
