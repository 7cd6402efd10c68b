"""The gain of a linear-quadratic regulator, by the discrete algebraic Riccati equation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from phihp_torchrl.baselines.point import Matrix, half_ranges
from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task


class Regulator(NamedTuple):
    r"""The law ``u = -K z`` that is cheapest, and what it costs.

    Args:
        gain: K, ``[m, n]``.
        cost: P of the cost-to-go :math:`z^\top P z`, ``[n, n]``.
    """

    gain: Matrix
    cost: Matrix


def solve_regulator(
    task: Task, a: Matrix, b: Matrix, q: Matrix, r: Matrix, names: Sequence[str]
) -> Regulator:
    """Solve for the regulator of ``z[k+1] = A z[k] + B u[k]``.

    Args:
        task: the task, whose physical components are the first of z.
        a: A, ``[n, n]``.
        b: B, ``[n, m]``.
        q: weights of z, ``[n, n]``.
        r: weights of u, ``[m, m]``.
        names: names of the components of z.

    Raises:
        ConfigError: where the action cannot stabilise it, naming the component that it does not
            reach, and where the equation has no solution.
    """
    from scipy.linalg import solve_discrete_are  # which few of those who import us need

    if lost := unstabilisable(task, a, b, names):
        actions = ", ".join(task.system.action_names)
        raise ConfigError(
            "dynamics",
            f"expected a model that can be stabilised at the goal, but {actions} does not reach "
            f"the mode of {lost}; another goal or more actions are needed.",
        )
    try:
        cost = solve_discrete_are(a, b, q, r)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ConfigError(
            "dynamics", f"expected a Riccati equation with a solution at the goal: {error}"
        ) from error
    weighed = b.T @ cost
    return Regulator(np.linalg.solve(r + weighed @ b, weighed @ a), cost)


def unstabilisable(task: Task, a: Matrix, b: Matrix, names: Sequence[str]) -> str:
    """The component that most moves in a mode which neither decays nor obeys; empty if none does.

    By the test of Popov, Belevitch and Hautus: a mode of a modulus of 1 or more needs
    ``[A - λ I, B]`` of full rank. Units are half-ranges.
    """
    ranges, reach = (part.numpy() for part in half_ranges(task))
    ranges = np.concatenate([ranges, np.ones(len(a) - len(ranges))])
    a = a * ranges[None] / ranges[:, None]
    b = b * reach[None] / ranges[:, None]
    for eigenvalue in np.linalg.eigvals(a):
        if abs(eigenvalue) < 1.0 - 1e-9:
            continue
        pencil = np.concatenate([a - eigenvalue * np.eye(len(a)), b], 1)
        left, sizes, _ = np.linalg.svd(pencil)
        if sizes[-1] < 1e-9 * sizes[0]:
            name = names[int(np.abs(left[:, -1]).argmax())]
            return f"{name} (modulus {abs(eigenvalue):.4g} a step)"
    return ""
