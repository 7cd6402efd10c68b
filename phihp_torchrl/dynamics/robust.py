r"""Huber's loss (1964): squares near zero, straight lines for what is far off.

.. math::
    \rho(e) = \begin{cases}
        e^2 & |e| \le k\sigma \\
        k\sigma\,(2|e| - k\sigma) & |e| > k\sigma
    \end{cases}

with the spread σ of each component, estimated from the errors themselves. Its minimum is found by
least squares with rows weighted by :math:`\min(1, k\sigma/|e|)`, because the weighted squares lie
above it (Huber, 1964, https://doi.org/10.1214/aoms/1177703732; Holland and Welsch, 1977).
"""

from __future__ import annotations

from torch import Tensor

_FLOOR = 1e-6  # near the rounding of float32, where a spread would be that of rounding errors


def robust_spread(errors: Tensor) -> Tensor:
    """Standard deviation ``[n]`` of most of the errors ``[N, n]``, from their median size.

    Examples:
        >>> import torch
        >>> errors = torch.randn(1000, 1, generator=torch.Generator().manual_seed(0))
        >>> errors[:50] = 1e3
        >>> round(robust_spread(errors).item(), 1)
        1.0
    """
    # 0.6745 is the median of |e| of a normal distribution with standard deviation 1.
    return (errors.abs().median(0).values / 0.6745).clamp_min(_FLOOR)


def huber_weight(errors: Tensor, bend: Tensor) -> Tensor:
    """Weight of each squared error ``[N, n]``, in (0, 1].

    Args:
        errors: errors ``[N, n]``.
        bend: the size from which errors count less, kσ, ``[n]``.

    Examples:
        >>> import torch
        >>> huber_weight(torch.tensor([[0.5], [4.0]]), torch.tensor([2.0])).flatten()
        tensor([1.0000, 0.5000])
    """
    return (bend / errors.abs().clamp_min(1e-30)).clamp_max(1.0)


def huber_loss(errors: Tensor, bend: Tensor) -> Tensor:
    """Loss of each error ``[N, n]``; the arguments are those of :func:`huber_weight`.

    Examples:
        >>> import torch
        >>> huber_loss(torch.tensor([[0.5], [4.0]]), torch.tensor([2.0])).flatten()
        tensor([ 0.2500, 12.0000])
    """
    near = errors.abs().minimum(bend)
    return near * (2.0 * errors.abs() - near)
