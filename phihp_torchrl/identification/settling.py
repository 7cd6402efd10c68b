"""A fit and the noise that it leaves, estimated by turns."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.identification.shooting import Fit, Shooting


def settle(
    shooting: Shooting,
    raw: Tensor,
    starts: Tensor,
    sigma: Tensor | None = None,
    rounds: int = 3,
    iterations: int = 15,
) -> Fit:
    """Fit, and estimate the noise from what remains, by turns.

    Args:
        shooting: the windows and the equations.
        raw: first guess of the parameters.
        starts: first guess of the starts.
        sigma: first guess of the noise; by default what remains when the starts alone are fitted.
        rounds: how often the noise is estimated anew.
        iterations: steps at most in each round.
    """
    if sigma is None:
        windows = shooting.windows
        sigma = noise(windows.measured - starts[:, None], windows.mask, 0)
        sigma = noise(
            shooting.fit(sigma, raw, starts, iterations=3, learn=False).residual,
            windows.mask,
            starts.shape[1] * len(starts),
        )
    for _ in range(rounds):
        fit = shooting.fit(sigma, raw, starts, iterations=iterations)
        raw, starts = fit.raw, fit.starts
        before = sigma
        used = len(raw) + starts.numel()
        sigma = noise(fit.residual, shooting.windows.mask, used)
        if ((sigma / before).log().abs() < 0.03).all():
            break
    return fit


def noise(residual: Tensor, mask: Tensor, used: int) -> Tensor:
    """Robust standard deviation of residuals, ``[n]``; 1 for states that were never measured.

    Residuals beyond three of the standard deviations that their median suggests are left out.

    Args:
        residual: ``[W, L, n]``.
        mask: where something was measured.
        used: parameters and starts that were fitted to it, over all states.
    """
    total = int(mask.sum())
    factor = (total / max(total - used, 0.1 * total, 1)) ** 0.5
    found = []
    for r, known in zip(residual.unbind(-1), mask.unbind(-1), strict=True):
        size = r[known].abs()
        if not len(size):
            found.append(r.new_ones(()))
            continue
        reach = 3.0 * 1.4826 * size.median()
        kept = size[size <= reach]
        found.append(factor * kept.square().mean().sqrt() / 0.9867)
    sigma = torch.stack(found)
    return sigma.clamp_min(1e-9)
