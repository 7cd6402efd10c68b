"""The solution of M x = r for the mass matrix of a mechanical system."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

LARGEST_UNROLLED = 6
"""Unknowns up to which :func:`solve_positive` writes the solution out."""


def solve_positive(mass: list[list[Tensor]], right: list[Tensor]) -> list[Tensor]:
    """Solve M x = r for a positive definite M, given by its lower triangle.

    Up to :data:`LARGEST_UNROLLED` unknowns M = L D Lᵀ is written out as products of tensors
    ``[*batch]``, which a compiler fuses with the equations around them. Beyond, LAPACK solves.

    Args:
        mass: row i of the lower triangle has i + 1 tensors ``[*batch]``.
        right: the right side, n tensors ``[*batch]``.
    """
    n = len(right)
    if n > LARGEST_UNROLLED:
        rows = [[mass[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
        matrix = torch.stack([torch.stack(row, -1) for row in rows], -2)
        return list(torch.linalg.solve(matrix, torch.stack(right, -1)).unbind(-1))
    lower: list[list[Tensor]] = []
    pivot: list[Tensor] = []
    for i in range(n):
        scaled: list[Tensor] = []  # L_ij D_j of row i
        for j in range(i):
            scaled.append(_less(mass[i][j], scaled, lower[j]))
        lower.append([a / d for a, d in zip(scaled, pivot, strict=True)])
        pivot.append(_less(mass[i][i], scaled, lower[i]))
    y: list[Tensor] = []
    for i in range(n):
        y.append(_less(right[i], y, lower[i]))
    x = [a / d for a, d in zip(y, pivot, strict=True)]
    for i in reversed(range(n)):
        x[i] = _less(x[i], x[i + 1 :], [lower[k][i] for k in range(i + 1, n)])
    return x


def _less(value: Tensor, one: Sequence[Tensor], other: Sequence[Tensor]) -> Tensor:
    """``value`` less the scalar product of two lists, the longer of which is cut."""
    for a, b in zip(one, other, strict=False):
        value = value - a * b
    return value
