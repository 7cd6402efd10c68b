"""Noise that is correlated along the horizon, with a power law as its spectrum."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


def colored(white: Tensor, beta: float, dim: int) -> Tensor:
    r"""Turn white noise into noise whose spectrum is :math:`f^{-\beta}` along one dimension.

    Each value keeps mean 0 and standard deviation 1, so that only the smoothness of a sequence
    changes: 0 is white noise, 1 pink, 2 that of a random walk. It is the noise of iCEM (Pinneri et
    al., 2020, https://arxiv.org/abs/2008.06389), but not periodic: a sequence is the first half of
    a periodic one of twice its length.

    Args:
        white: standard normal noise of any shape.
        beta: exponent of the spectrum, at least 0.
        dim: the dimension along which it is correlated.

    Returns:
        The noise, of the same shape; ``white`` itself where ``beta`` is 0.

    Examples:
        >>> white = torch.randn(20, 1000, generator=torch.Generator().manual_seed(0))
        >>> smooth = colored(white, beta=2.0, dim=0)
        >>> white.diff(dim=0).std() > 2 * smooth.diff(dim=0).std()
        tensor(True)
    """
    if not beta:
        return white
    factor = _factor(white.shape[dim], beta).to(white)
    return torch.tensordot(white, factor, dims=([dim], [1])).movedim(-1, dim)


@lru_cache(maxsize=64)
def _factor(steps: int, beta: float) -> Tensor:
    """A root ``[steps, steps]`` of the covariance of ``steps`` values, in float64."""
    whole = 2 * steps
    # The constant part has the power of the lowest frequency, which keeps it finite.
    frequency = torch.fft.fftfreq(whole, dtype=torch.float64).abs().clamp_min(1 / whole)
    covariance = torch.fft.ifft(frequency**-beta).real
    lag = torch.arange(steps)
    matrix = (covariance / covariance[0])[(lag[:, None] - lag).abs()]
    values, vectors = torch.linalg.eigh(matrix)
    return vectors * values.clamp_min(0).sqrt()
