"""How sure a fit is: directions that the data leave open, and errors of the others."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from phihp_torchrl.identification.shooting import Fit

_OPEN = 0.3
"""Standard error of a logarithm from which on a direction counts as not determined."""
SHARE = 0.1
"""Part that a parameter must have in such a direction to be touched by it."""


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


def monomials(open_directions: Tensor, among: list[int]) -> list[dict[int, float]] | None:
    """Products of powers that stay the same along open directions.

    Args:
        open_directions: in logarithms of the constants, ``[d, p]``.
        among: parameters that may take part; their constants are positive.

    Returns:
        Exponents by parameter, for each product; ``None`` if the exponents are not simple ratios.

    Examples:
        >>> monomials(torch.tensor([[0.6, 0.0, 0.6]]), [0, 1, 2])
        [{2: 1.0, 0: -1.0}]
    """
    inside = [i for i in among if bool((open_directions[:, i].abs() > SHARE).any())]
    if not inside:
        return []
    matrix, pivots = _reduced(open_directions[:, inside])
    found = []
    for column, i in enumerate(inside):
        if column in pivots:
            continue
        exponents = {i: 1.0}
        for row, pivot in enumerate(pivots):
            exact = -float(matrix[row, column])
            simple = round(6.0 * exact) / 6.0  # halves and thirds
            if abs(simple - exact) > 0.03:
                return None
            if simple:
                exponents[inside[pivot]] = simple
        found.append(exponents)
    return found


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
