"""Which of two models is better, by paired errors, some of which are far off."""

from __future__ import annotations

from torch import Tensor


def signed_rank(gain: Tensor) -> float:
    """How many standard errors paired gains are above none, by their ranks (Wilcoxon, 1945).

    A mean of gains and its standard error are blunted by a few windows, such as those near a stop
    or those that met a disturbance, in which both models are far off. Ranks are not.

    Args:
        gain: differences ``[W]``. Those that are zero do not count.

    Returns:
        The sum of the ranks of their sizes, with their signs, over its standard deviation if either
        sign were as likely; 0 where nothing differs.

    Examples:
        >>> import torch
        >>> gain = torch.tensor([0.5, 0.4, 0.0, -0.1, 0.6, 0.7, -90.0])
        >>> round(signed_rank(gain), 2)  # ranks 3, 2, -1, 4, 5, -6
        0.73
        >>> round(signed_rank(gain.abs()), 2), signed_rank(torch.zeros(3))
        (2.2, 0.0)
    """
    gain = gain[gain != 0]
    if not len(gain):
        return 0.0
    rank = gain.abs().argsort().argsort().to(gain) + 1.0
    return float((gain.sign() * rank).sum() / rank.square().sum().sqrt())
