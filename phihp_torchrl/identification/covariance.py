"""How sure a fit is: directions that the data leave open, and errors of the others."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from phihp_torchrl.identification.shooting import Fit

_OPEN = 0.3
"""Standard error of a logarithm from which on a direction counts as not determined."""
SHARE = 0.1
"""Part that a parameter must have in such a direction to be touched by it."""
_STEEPEST = 4.0
"""The largest power of a product. Larger ones are no physics, but any number is near to one."""
_PAIRED = {0.5, 1.0, 2.0}
"""Powers in pairs that are tried one by one, where many tries make a chance hit likely."""


@dataclass(frozen=True)
class Uncertainty:
    """Errors of parameters, in logarithms of constants or in shares of their range.

    Args:
        scale: derivative of those by the parameters, ``[p]``.
        open: directions that the data leave open, orthonormal, ``[d, p]``.
        sandwich: covariance ``[p, p]`` that holds where residuals of one window belong together, as
            they do where the equations leave something out (White, 1980; one cluster a window).
        plain: covariance ``[p, p]`` for independent residuals of the estimated noise.
        quantile: standard errors on each side of an interval. All intervals together hold with
            95 % (Bonferroni's inequality, for as many as there are parameters that are not open).
    """

    scale: Tensor
    open: Tensor
    sandwich: Tensor
    plain: Tensor
    quantile: float

    def reach(self, direction: Tensor) -> float:
        """Half the 95 % interval of a linear combination ``[p]``, by the larger covariance."""
        found = [float(direction @ matrix @ direction) for matrix in (self.sandwich, self.plain)]
        return self.quantile * max(*found, 0.0) ** 0.5

    def touches(self, direction: Tensor) -> bool:
        """Whether a combination changes along a direction that is open."""
        unit = direction / direction.norm().clamp_min(1e-300)
        return bool((self.open @ unit).norm() > SHARE)


def uncertainty(fit: Fit, scale: Tensor) -> Uncertainty:
    """Find what the data leave open, and the covariance of the rest.

    Args:
        fit: information and scores of the parameters.
        scale: derivative of the logarithms (or shares) by the parameters, ``[p]``.
    """
    scale = scale.clamp_min(1e-12)
    information = fit.information / (scale[:, None] * scale)
    information = 0.5 * (information + information.mT)
    scores = fit.scores / scale
    clusters, count = scores.shape
    # Residuals are smaller than errors, for parameters and starts have been fitted to them.
    used = count / clusters + fit.starts.shape[1] / max(_measurements(fit), 1.0)
    meat = scores.mT @ scores / max(1.0 - used, 0.5)
    values, vectors = torch.linalg.eigh(information)
    values = values.clamp_min(1e-12)
    spread = (vectors * (meat @ vectors)).sum(0) / values.square()
    error = torch.maximum(spread, 1.0 / values).sqrt()
    closed = error <= _OPEN
    bread = (vectors[:, closed] / values[closed]) @ vectors[:, closed].mT
    return Uncertainty(
        scale,
        vectors[:, ~closed].mT,
        bread @ meat @ bread,
        bread,
        _quantile(clusters - 1, max(int(closed.sum()), 1)),
    )


def _measurements(fit: Fit) -> float:
    """Measurements in a window, on average."""
    return float((fit.residual != 0).sum() / len(fit.residual))


def _quantile(freedom: int, intervals: int) -> float:
    """The quantile of Student's t for so many intervals (Fisher and Cornish's expansion)."""
    level = torch.tensor(1.0 - 0.025 / intervals, dtype=torch.float64)
    z, n = float(torch.special.ndtri(level)), max(freedom, 3)
    return z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)


def monomials(open_directions: Tensor, among: list[int]) -> list[dict[int, float]]:
    """Products of powers that stay the same along open directions.

    A direction may be simple for some constants alone: a motor's torque constant stands in the drag
    as well, as what it brakes, and so only the others go with it in proportion. Products of those
    are found, pairs of them where the products that come first leave any out.

    Args:
        open_directions: in logarithms of the constants, ``[d, p]``.
        among: parameters that may take part; their constants are positive.

    Returns:
        Exponents by parameter, for each product. Those that are no simple ratios are left out.

    Examples:
        >>> monomials(torch.tensor([[0.6, 0.0, 0.6]]), [0, 1, 2])
        [{2: 1.0, 0: -1.0}]
        >>> monomials(torch.tensor([[0.14, 0.57, 0.57, 0.57]]), [0, 1, 2, 3])
        [{2: 1.0, 1: -1.0}, {3: 1.0, 1: -1.0}]
    """
    inside = [i for i in among if bool((open_directions[:, i].abs() > SHARE).any())]
    if not inside:
        return []
    products = _products(open_directions, inside)
    found = [product for product in products if product]
    if len(found) == len(products):
        return found
    for i, j in itertools.combinations(inside, 2):
        for pair in _products(open_directions, [i, j]):
            plain = pair and {abs(power) for power in pair.values()} <= _PAIRED
            if plain and _rank([*found, pair], inside) > len(found):
                found.append(pair)
    return found


def _products(open_directions: Tensor, inside: list[int]) -> list[dict[int, float]]:
    """One product for each dimension that these parameters leave; empty where it is not simple."""
    matrix, pivots = _reduced(open_directions[:, inside])
    free = [column for column in range(len(inside)) if column not in pivots]
    return [
        _simple(matrix[:, column], [inside[p] for p in pivots], inside[column]) for column in free
    ]


def _simple(column: Tensor, pivots: list[int], own: int) -> dict[int, float]:
    """Exponents of a product, or none if they are not simple ratios."""
    exponents = {own: 1.0}
    for pivot, value in zip(pivots, column.tolist(), strict=True):
        simple = min(
            round(-2.0 * value) / 2.0, round(-3.0 * value) / 3.0, key=lambda s: abs(s + value)
        )
        if abs(simple + value) > 0.03 or abs(simple) > _STEEPEST:
            return {}
        if simple:
            exponents[pivot] = simple
    return exponents


def _rank(products: list[dict[int, float]], inside: list[int]) -> int:
    """How many of the products do not follow from the others."""
    exponents = [[product.get(i, 0.0) for i in inside] for product in products]
    return int(torch.linalg.matrix_rank(torch.tensor(exponents, dtype=torch.float64)))


def _reduced(matrix: Tensor) -> tuple[Tensor, list[int]]:
    """Reduced row echelon form, and the column of each row's pivot."""
    matrix, pivots, row = matrix.clone(), [], 0
    for column in range(matrix.shape[1]):
        if row == len(matrix):
            break
        best = row + int(matrix[row:, column].abs().argmax())
        if matrix[best, column].abs() < SHARE:
            continue
        matrix[[row, best]] = matrix[[best, row]]
        matrix[row] = matrix[row] / matrix[row, column]
        for other in range(len(matrix)):
            if other != row:
                matrix[other] -= matrix[other, column] * matrix[row]
        pivots.append(column)
        row += 1
    return matrix[:row], pivots
