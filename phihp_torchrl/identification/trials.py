"""Small fits, which tell one model from another by windows that they were not fitted to."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.dynamics import signed_rank
from phihp_torchrl.identification.model import Model
from phihp_torchrl.identification.settling import noise
from phihp_torchrl.identification.shooting import Shooting, robust
from phihp_torchrl.identification.windows import Samples, Windows, first_starts

WINDOWS = 160
"""Windows of a trial; every other one is fitted, where there are enough."""
_ENOUGH = 24
"""Windows below which all are fitted and judged, for half of them could tell nothing apart."""
_PRICE = 2.0
"""What a fitted number costs, in units of the noise's variance, where all windows are fitted."""
_CLEAR = 3.0
"""Standard errors by which windows of a richer model must be better, by their ranks or mean."""
_WORTH = 0.005
"""Share of the error by which a richer model must be better."""

_EXACT = 1e-6
"""Residuals below this share of the motion are rounding."""


class Trial(NamedTuple):
    """A model that was fitted to few windows.

    Args:
        part: what it is, in words.
        model: the model.
        raw: its parameters ``[p]``.
        starts: ``[W, n]``.
        residual: fitted minus measured, in units of the states, ``[W, L, n]``.
    """

    part: str
    model: Model
    raw: Tensor
    starts: Tensor
    residual: Tensor


class Trials:
    """Fits models to the same few windows, and compares them.

    Args:
        samples: the recordings.
        windows: windows of them.
    """

    def __init__(self, samples: Samples, windows: Windows) -> None:
        self.samples, self.windows = samples, windows
        count = len(windows.time)
        self.apart = count >= _ENOUGH
        self.teaching = torch.arange(count) % 2 == 0 if self.apart else torch.ones(count).bool()

    def attempt(
        self, part: str, model: Model, raw: Tensor, like: Trial | None = None, rounds: int = 1
    ) -> Trial:
        """Fit a model.

        Args:
            part: what it is, in words.
            model: the model.
            raw: first guess of its parameters.
            like: an earlier trial, whose starts and noise are first guesses.
            rounds: how often the noise is estimated anew.
        """
        shooting = Shooting(model, self.samples, self.windows, self.teaching)
        starts = first_starts(model.prior.system, self.windows) if like is None else like.starts
        if like is None:
            sigma = noise(starts[:, None] - self.windows.measured, self.windows.mask, 0)
            fit = shooting.fit(sigma, raw, starts, iterations=3, learn=False)
            residual = fit.residual
        else:
            residual = like.residual
        for _ in range(rounds):
            sigma = noise(residual, self.windows.mask, len(raw) + starts.numel())
            fit = shooting.fit(sigma, raw, starts, iterations=6)
            raw, starts, residual = fit.raw, fit.starts, fit.residual
        return Trial(part, model, raw, starts, residual)

    @property
    def judged(self) -> Tensor:
        """The windows by which trials are judged, bool ``[W]``: those not fitted, if there are."""
        return ~self.teaching if self.apart else self.teaching

    def losses(self, trial: Trial, sigma: Tensor) -> Tensor:
        """Robust loss of each judged window, and the price of what was fitted to it."""
        loss = robust(trial.residual[self.judged] / sigma).sum((1, 2))
        return loss if self.apart else loss + _PRICE * len(trial.raw) / len(loss)

    def noise(self, trial: Trial) -> Tensor:
        """What a trial takes for noise, ``[n]``."""
        return noise(trial.residual, self.windows.mask, len(trial.raw) + trial.starts.numel())

    def cost(self, trial: Trial, best: Trial) -> float:
        """Loss per measurement in units of the noise that ``best`` has."""
        losses = self.losses(trial, self.noise(best))
        return float(losses.sum() / self.windows.mask[self.judged].sum())

    def better(self, trial: Trial, best: Trial) -> bool:
        """Whether windows are clearly better (or all of them), and by half a percent together."""
        sigma = self.noise(best)
        if self.is_exact(sigma):
            return False
        before = self.losses(best, sigma)
        gain = before - self.losses(trial, sigma)
        mean = float(
            gain.mean() / gain.std() * len(gain) ** 0.5
        )  # the ranks of few cannot be clear
        clear = max(signed_rank(gain), mean) >= _CLEAR
        everywhere = bool((gain > 0).all()) and len(gain) >= 5
        return (clear or everywhere) and bool(gain.sum() > _WORTH * before.sum())

    def is_exact(self, sigma: Tensor) -> bool:
        """Whether nothing is left but rounding, which no model explains."""
        mask, measured = self.windows.mask, self.windows.measured
        seen = mask.any(0).any(0).nonzero().flatten().tolist()
        spreads = {i: measured[..., i][mask[..., i]].std() for i in seen}
        return all(bool(sigma[i] < _EXACT * spread) for i, spread in spreads.items())
