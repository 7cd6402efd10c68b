r"""Multiple shooting: short trajectories with free starts, fitted to what was measured of them.

.. math::
    \min_{\theta, x_0^{(1)}, \dots, x_0^{(W)}} \sum_w \sum_t
    \rho\Big(\frac{y_t^{(w)} - x_t^{(w)}(\theta, x_0^{(w)})}{\sigma}\Big)

The starts are free, so noise in the measurements does not bias the parameters as it does in a fit
of one-step errors, and velocities need not be measured. The loss :math:`\rho` is pseudo-Huber, so
that outliers and steps that the equations do not describe count little (Bock, 1983; Huber, 1964).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from phihp_torchrl.identification.model import Model
from phihp_torchrl.identification.windows import Samples, Windows

KNEE = 3.0
"""Residuals beyond so many standard deviations count linearly."""

_SPREAD = 3.0
"""Standard deviation of the weak belief in the first guesses, in units of the parameters.

It is a factor of twenty for a free constant. It matters only where the data say nothing.
"""


class Fit(NamedTuple):
    """Parameters and starts that fit.

    Args:
        raw: parameters ``[p]``.
        starts: ``[W, n]``.
        states: fitted trajectories, ``[W, L, n]``.
        residual: fitted minus measured, in units of the states, 0 where nothing was measured.
        sigma: standard deviation of each state's measurements, ``[n]``.
        cost: the sum that was minimised.
        information: second derivatives of the cost by the parameters, the starts adapting,
            ``[p, p]``, for residuals of that standard deviation.
        scores: gradient of each window's cost by the parameters, likewise, ``[W, p]``.
        iterations: how many it took.
    """

    raw: Tensor
    starts: Tensor
    states: Tensor
    residual: Tensor
    sigma: Tensor
    cost: float
    information: Tensor
    scores: Tensor
    iterations: int


def simulate(model: Model, raw: Tensor, starts: Tensor, acting: Tensor, windows: Windows) -> Tensor:
    """States at each sample, ``[W, L, n]``, from starts ``[W, n]``; ``acting`` is ``[W, L, m]``."""
    states = [starts]
    for held, seconds in zip(acting.unbind(1), windows.interval.unbind(1), strict=False):
        states.append(model.step(raw, states[-1], held, seconds))
    return torch.stack(states, 1)


class Shooting:
    """Gauss-Newton steps for one set of windows.

    The starts of different windows do not meet, so they are eliminated window by window, and a step
    costs no more than one with the parameters alone.

    Args:
        model: the equations.
        samples: the recordings.
        windows: stretches of them.
        teaching: which windows the parameters are fitted to, bool ``[W]``; by default all. The
            starts of the others are fitted too, so that they tell how well the parameters serve
            elsewhere.
    """

    def __init__(
        self, model: Model, samples: Samples, windows: Windows, teaching: Tensor | None = None
    ) -> None:
        self.model, self.samples, self.windows = model, samples, windows
        self.teaching = torch.ones(len(windows.time), dtype=torch.bool)
        if teaching is not None:
            self.teaching = teaching
        self.guess = model.first()
        self._known: tuple[Tensor, Tensor] | None = None
        spread = samples.state.nan_to_num().std(0)
        self.scale = torch.cat([spread.clamp_min(1e-3), samples.action.std(0).clamp_min(1e-3)])

    def fit(
        self, sigma: Tensor, raw: Tensor, starts: Tensor, *, iterations: int, learn: bool = True
    ) -> Fit:
        """Fit from a first guess, by Levenberg's and Marquardt's damping.

        Args:
            sigma: standard deviation of each state's measurements, ``[n]``.
            raw: first guess of the parameters ``[p]``.
            starts: first guess ``[W, n]``.
            iterations: steps at most.
            learn: ``False`` leaves the parameters as they are and fits the starts alone.
        """
        damping, count = 1e-3, 0
        states, residual, cost = self._evaluate(raw, starts, sigma)
        while count < iterations:
            count += 1
            blocks = self._blocks(raw, states, residual, sigma, learn)
            for _ in range(10):
                change, shift = _solve(blocks, damping, self.teaching)
                trial = raw + change, starts + shift
                found = self._evaluate(*trial, sigma)
                if found[2] < cost:
                    break
                damping = min(5.0 * damping, 1e9)
            else:
                break
            done = cost - found[2] < 1e-6 * cost
            (raw, starts), (states, residual, cost) = trial, found
            damping = max(damping / 8.0, 1e-10)
            if done:
                break
        information, scores = raw.new_zeros(0, 0), raw.new_zeros(0, 0)
        if learn:
            information, scores = self._information(raw, states, residual, sigma)
        return Fit(raw, starts, states, residual * sigma, sigma, cost, information, scores, count)

    def information(self, raw: Tensor, starts: Tensor, sigma: Tensor) -> Tensor:
        """What the windows would tell of the parameters, were they measured as they are simulated.

        Args:
            raw: parameters ``[p]``.
            starts: ``[W, n]``.
            sigma: noise of each state; those that are NaN throughout are not measured.
        """
        acting = self.model.acting(self.samples, raw)[self.windows.index]
        states = simulate(self.model, raw, starts, acting, self.windows)
        measured = self.windows._replace(mask=self.windows.mask | ~self.samples.state.isnan()[:1])
        other = Shooting(self.model, self.samples, measured)
        other.scale = self.scale
        return other._information(raw, states, torch.zeros_like(states), sigma)[0]

    def _evaluate(self, raw: Tensor, starts: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor, float]:
        """Trajectories, residuals in units of the standard deviations, and the cost."""
        windows = self.windows
        states = simulate(self.model, raw, starts, self._acting(raw), windows)
        error = (states - windows.measured) / sigma
        residual = torch.where(windows.mask, error, torch.zeros_like(error))
        believed = ((raw - self.guess) / _SPREAD).square().sum()
        value = float(robust(residual[self.teaching]).sum() + believed)
        return states, residual, value if value == value else float("inf")

    def _acting(self, raw: Tensor) -> Tensor:
        """What acts in each window, ``[W, L, m]``; it is known from the last call for the same."""
        parts = raw[self.model.constants :]
        if self._known is None or not torch.equal(self._known[0], parts):
            self._known = parts, self.model.acting(self.samples, raw)[self.windows.index]
        return self._known[1]

    def _sensitivities(self, raw: Tensor, states: Tensor, learn: bool) -> tuple[Tensor, Tensor]:
        """Derivatives of the states by the parameters and the starts, ``[W, L, n, p | n]``.

        By the chain rule from sample to sample: with the derivatives A of a step by the state and B
        by the parameters, those of the state become A times themselves, plus B.
        """
        windows, model = self.windows, self.model
        count, length, size = states.shape
        flat = [x[:, :-1].flatten(0, 1) for x in (states, self._acting(raw))]
        by_state, by_action, by_constant = model.slopes(
            raw, flat[0], flat[1], windows.interval.flatten(), self.scale, learn=learn
        )
        by_raw = by_constant
        if learn:
            paths = model.acting_slopes(self.samples, raw)[windows.index][:, :-1].flatten(0, 1)
            by_raw = torch.cat([by_constant, by_action @ paths], -1)
        steps = torch.cat([by_state, by_raw], -1).unflatten(0, (count, length - 1))
        rows = [torch.eye(size, dtype=states.dtype).expand(count, size, size)]
        rows[0] = torch.cat([rows[0], states.new_zeros(count, size, by_raw.shape[-1])], -1)
        for step in steps.unbind(1):
            ahead = step[..., :size] @ rows[-1]
            ahead[..., size:] += step[..., size:]
            rows.append(ahead)
        whole = torch.stack(rows, 1)
        return whole[..., size:], whole[..., :size]

    def _blocks(
        self, raw: Tensor, states: Tensor, residual: Tensor, sigma: Tensor, learn: bool
    ) -> _Blocks:
        weight = (1.0 + (residual / KNEE).square()).rsqrt()
        blocks = self._weighted(raw, states, residual, sigma, weight, weight, learn)
        belief = torch.ones_like(raw) / _SPREAD**2
        return blocks._replace(belief=belief, pull=belief * (raw - self.guess))

    def _information(
        self, raw: Tensor, states: Tensor, residual: Tensor, sigma: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Information and scores of the parameters, the starts adapting, without any belief."""
        slope = (1.0 + (residual / KNEE).square()).rsqrt()  # psi(r) / r
        bend = slope**3  # its derivative
        blocks = self._weighted(raw, states, residual, sigma, bend, slope, True)
        starts = _damped(blocks.starts, 1e-10)
        eliminated = torch.linalg.solve(starts, blocks.mixed.mT)
        pulled = torch.linalg.solve(starts, blocks.start_gradient[..., None])
        each = blocks.parameters - blocks.mixed @ eliminated
        scores = blocks.gradient - (blocks.mixed @ pulled)[..., 0]
        return each[self.teaching].sum(0), scores[self.teaching]

    def _weighted(
        self,
        raw: Tensor,
        states: Tensor,
        residual: Tensor,
        sigma: Tensor,
        bend: Tensor,
        slope: Tensor,
        learn: bool,
    ) -> _Blocks:
        by_raw, by_start = self._sensitivities(raw, states, learn)
        scale = (self.windows.mask / sigma)[..., None]
        by_raw, by_start = ((x * scale).flatten(1, 2) for x in (by_raw, by_start))
        weight, pull = bend.flatten(1, 2)[..., None], (slope * residual).flatten(1, 2)[..., None]
        left, right = (by_raw * weight).mT, (by_start * weight).mT
        return _Blocks(
            parameters=left @ by_raw,
            mixed=left @ by_start,
            starts=right @ by_start,
            gradient=(by_raw.mT @ pull)[..., 0],
            start_gradient=(by_start.mT @ pull)[..., 0],
            belief=torch.zeros_like(raw),
            pull=torch.zeros_like(raw),
        )


class _Blocks(NamedTuple):
    """Normal equations window by window: parameters, starts, and what ties them."""

    parameters: Tensor
    mixed: Tensor
    starts: Tensor
    gradient: Tensor
    start_gradient: Tensor
    belief: Tensor
    pull: Tensor


def _solve(blocks: _Blocks, damping: float, teaching: Tensor) -> tuple[Tensor, Tensor]:
    """A damped Gauss-Newton step of parameters ``[p]`` and starts ``[W, n]``."""
    starts = _damped(blocks.starts, damping)
    pulled = torch.linalg.solve(starts, blocks.start_gradient[..., None])
    change = torch.zeros_like(blocks.belief)
    if not blocks.gradient.shape[-1]:  # the starts alone
        return change, -pulled[..., 0]
    eliminated = torch.linalg.solve(starts, blocks.mixed.mT)
    full = _damped(blocks.parameters[teaching].sum(0), damping) + blocks.belief.diag()
    matrix = full - (blocks.mixed @ eliminated)[teaching].sum(0)
    gradient = (blocks.gradient - (blocks.mixed @ pulled)[..., 0])[teaching].sum(0) + blocks.pull
    change = -torch.linalg.lstsq(matrix, gradient[:, None], driver="gelsd").solution[:, 0]
    change = change.clamp(-1.5, 1.5)
    return change, -(pulled[..., 0] + (eliminated @ change[:, None])[..., 0])


def _damped(matrix: Tensor, damping: float) -> Tensor:
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    floor = 1e-12 * diagonal.amax(-1, keepdim=True) + 1e-300
    return matrix + torch.diag_embed(damping * diagonal.clamp_min(floor) + floor)


def robust(residual: Tensor) -> Tensor:
    """The pseudo-Huber loss of residuals in units of their standard deviations."""
    return 2.0 * KNEE**2 * ((1.0 + (residual / KNEE).square()).sqrt() - 1.0)
