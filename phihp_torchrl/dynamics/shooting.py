"""Fit of a model by multiple shooting, which sensor noise does not bias."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.func import functional_call, jacrev, vmap

from phihp_torchrl.dynamics.fit_config import FitConfig
from phihp_torchrl.dynamics.loss import DynamicsLoss
from phihp_torchrl.dynamics.parameters import ParameterVector

_HUGE = 1e6
"""Size of an error, in steps, at which a window has diverged."""


@dataclass(frozen=True)
class Windows:
    """Measured stretches of consecutive steps; the last one of an episode may be shorter.

    Args:
        states: what was measured, ``[B, W + 1, n]``.
        actions: what acted in each step, ``[B, W, m]``.
        seconds: duration of each step, ``[B, W, 1]``.
        known: whether a sample belongs to the stretch, ``[B, W + 1]``.
    """

    states: Tensor
    actions: Tensor
    seconds: Tensor
    known: Tensor

    def __getitem__(self, index: Tensor) -> Windows:
        return Windows(
            self.states[index], self.actions[index], self.seconds[index], self.known[index]
        )


def cut_windows(loss: DynamicsLoss, data: TensorDictBase, length: int) -> Windows:
    """Cut transitions ``[N]`` into windows of up to ``length`` consecutive steps.

    Rows are consecutive where the observation after one is the observation before the next.
    """
    state, action, following = loss.transitions(data)
    seconds = loss.time_step(data)
    if seconds is None:
        seconds = torch.full_like(state[:, :1], loss.dynamics.task.time_step)
    key = loss.tensor_keys.observation
    ahead, here = data.get("next").get(key)[:-1], data.get(key)[1:]
    joined = (ahead == here).all(-1).tolist()
    starts, lengths = [0], [1]
    for row, goes_on in enumerate(joined, start=1):
        if goes_on and lengths[-1] < length:
            lengths[-1] += 1
        else:
            starts.append(row)
            lengths.append(1)
    first, count = torch.tensor(starts)[:, None], torch.tensor(lengths)[:, None]
    steps = torch.arange(length)
    rows = (first + steps).minimum(first + count - 1)  # beyond the end the last step is repeated
    known = torch.cat([torch.ones_like(first, dtype=torch.bool), steps < count], 1)
    states = torch.cat([state[first], following[rows]], 1)
    return Windows(states, action[rows], seconds[rows], known)


@torch.no_grad()
def multiple_shooting(
    loss: DynamicsLoss,
    train: TensorDictBase,
    held_out: TensorDictBase,
    config: FitConfig,
    generator: torch.Generator | None,
) -> int:
    r"""Minimise the distance of trajectories with free starts to what was measured.

    .. math::
        \min_{\theta, x_0} \sum_{b, k} \lVert (y_{b,k} - x_{b,k}) / \sigma \rVert^2
        + \frac{1}{\lambda} \sum \lVert F^r \rVert^2, \qquad
        x_{b, k + 1} = \mathrm{ODESolve}(x_{b,k}, a_{b,k})

    by damped Gauss-Newton steps (Bock, 1987). A one-step error starts from a noisy state, and its
    least-squares solution explains that noise by wrong constants; here noise is what is left over.
    The starts are eliminated window by window, so a step costs about what one of
    Levenberg-Marquardt does. The noise σ of each component is estimated on the way.

    Returns:
        The steps taken. The parameters with the smallest error on held-out windows are kept.
    """
    problem = _Shooting(loss)
    windows = cut_windows(loss, train, config.window)
    reference = cut_windows(loss, held_out, config.window)
    theta = problem.vector.read()
    starts, checks = windows.states[:, 0].clone(), reference.states[:, 0].clone()
    loss.lambda_.fill_(config.initial_lambda)
    sigma = problem.noise(theta, starts, windows)
    damping, stale, steps = 1e-2, 0, 0
    best, best_error = theta, math.inf
    while steps < config.steps:
        steps += 1
        index = torch.arange(len(starts))
        if config.batch_size is not None and config.batch_size < len(train):
            share = config.batch_size / len(train)
            index = torch.randperm(len(starts), generator=generator)[: round(share * len(starts))]
        chosen = windows[index]
        actions = chosen.actions.flatten(0, 1)
        penalised = actions[torch.randperm(len(actions), generator=generator)]
        theta, moved, damping, improved = problem.step(
            theta, starts[index], chosen, sigma, damping, penalised
        )
        starts[index] = moved
        sigma = problem.noise(theta, starts, windows)
        checks = problem.settle(theta, checks, reference, sigma)
        error = problem.distance(theta, checks, reference)
        stale = 0 if error < 0.99 * best_error else stale + 1
        if error < best_error:
            best, best_error = theta, error
        final = loss.lambda_.item() >= config.final_lambda
        if final and (stale >= config.patience or not improved):
            break
        loss.lambda_.mul_(config.lambda_growth).clamp_(max=config.final_lambda)
    problem.vector.write(best)
    return steps


class _Shooting:
    """Trajectories of windows with free starts, by one parameter vector, and their derivatives."""

    def __init__(self, loss: DynamicsLoss) -> None:
        self.loss = loss
        self._model = _Step(loss)
        self.vector = ParameterVector(loss.dynamics)
        rows = (None, 0, 0, 0)
        self._steps = vmap(self._step, rows)
        self._slopes = vmap(jacrev(self._step, (0, 1)), rows)
        self._residuals = vmap(self._residual, (None, 0, 0))
        self._residual_slopes = vmap(jacrev(self._residual), (None, 0, 0))

    def _step(self, theta: Tensor, state: Tensor, action: Tensor, seconds: Tensor) -> Tensor:
        named = self.vector.unpack(theta, "dynamics.")
        return functional_call(self._model, named, (state, action, seconds))

    def _residual(self, theta: Tensor, state: Tensor, action: Tensor) -> Tensor:
        dynamics = self.loss.dynamics
        if dynamics.residual is None:
            return torch.zeros_like(state)
        start = "residual."
        parts = {
            name.removeprefix(start): value
            for name, value in self.vector.unpack(theta).items()
            if name.startswith(start)
        }
        return functional_call(dynamics.residual, parts, (state, action)) / self.loss.residual_scale

    def paths(self, theta: Tensor, starts: Tensor, windows: Windows) -> Tensor:
        """The trajectories from ``starts`` ``[B, n]``: ``[B, W + 1, n]``."""
        state, states = starts, [starts]
        for action, seconds in zip(
            windows.actions.unbind(1), windows.seconds.unbind(1), strict=True
        ):
            state = self._steps(theta, state, action, seconds)
            states.append(state)
        return torch.stack(states, 1)

    def errors(self, paths: Tensor, windows: Windows) -> Tensor:
        """What was measured less the trajectories, zero beyond the end, ``[B, W + 1, n]``."""
        error = self.loss.dynamics.task.difference(windows.states, paths)
        # A window that has diverged still counts, as a large number.
        error = error.nan_to_num(_HUGE, _HUGE, -_HUGE)
        return error * windows.known[..., None]

    def noise(self, theta: Tensor, starts: Tensor, windows: Windows) -> Tensor:
        """Standard deviation of the errors of each component, ``[n]``, robust to a few windows."""
        error = self.errors(self.paths(theta, starts, windows), windows)[windows.known]
        size = 1.4826 * error.abs().median(0).values
        return size.clamp_min(1e-6 * self.loss.error_scale.max()).maximum(
            1e-4 * self.loss.error_scale
        )

    def distance(self, theta: Tensor, starts: Tensor, windows: Windows) -> float:
        """Mean squared error of the trajectories, in steps."""
        error = self.errors(self.paths(theta, starts, windows), windows)[windows.known]
        return (error / self.loss.error_scale).square().sum(-1).mean().item()

    def settle(self, theta: Tensor, starts: Tensor, windows: Windows, sigma: Tensor) -> Tensor:
        """Move the starts alone by a Gauss-Newton step where that lowers the error of a window."""
        paths = self.paths(theta, starts, windows)
        errors = self.errors(paths, windows) / sigma
        through = self._through(theta, paths, windows, parameters=False)[1] / sigma[:, None]
        through = through * windows.known[..., None, None]
        normal = torch.einsum("bkij,bkil->bjl", through, through)
        gradient = torch.einsum("bkij,bki->bj", through, errors)
        moved = starts + _solve(normal, gradient[..., None])[..., 0]
        after = self.errors(self.paths(theta, moved, windows), windows) / sigma
        better = after.square().sum((1, 2)) < errors.square().sum((1, 2))
        return torch.where(better[:, None], moved, starts)

    def _through(
        self, theta: Tensor, paths: Tensor, windows: Windows, *, parameters: bool
    ) -> tuple[Tensor | None, Tensor]:
        """Derivatives of trajectories by the parameters and by their starts."""
        batch, length = windows.actions.shape[:2]
        rows = (paths[:, :-1].flatten(0, 1), windows.actions.flatten(0, 1))
        by_theta, by_state = self._slopes(theta, *rows, windows.seconds.flatten(0, 1))
        by_state = by_state.unflatten(0, (batch, length)).nan_to_num()
        size = paths.shape[-1]
        through = [torch.eye(size, dtype=paths.dtype).expand(batch, -1, -1)]
        for k in range(length):
            through.append(by_state[:, k] @ through[-1])
        if not parameters:
            return None, torch.stack(through, 1)
        by_theta = by_theta.unflatten(0, (batch, length)).nan_to_num()
        along = [torch.zeros_like(by_theta[:, 0])]
        for k in range(length):
            along.append(by_state[:, k] @ along[-1] + by_theta[:, k])
        return torch.stack(along, 1), torch.stack(through, 1)

    def step(
        self,
        theta: Tensor,
        starts: Tensor,
        windows: Windows,
        sigma: Tensor,
        damping: float,
        penalised: Tensor,
    ) -> tuple[Tensor, Tensor, float, bool]:
        """A damped step: parameters, starts, the new damping, and whether the cost has fallen."""
        paths = self.paths(theta, starts, windows)
        errors = self.errors(paths, windows) / sigma
        along, through = self._through(theta, paths, windows, parameters=True)
        assert along is not None
        mask = windows.known[..., None, None] / sigma[:, None]
        along, through = (along * mask).flatten(1, 2), (through * mask).flatten(1, 2)
        flat = errors.flatten(1, 2)
        weight = (sigma / self.loss.error_scale).square().mean()  # the penalty is one in steps
        seen = windows.states[:, :-1].flatten(0, 1)
        scale = (weight * self.loss.lambda_).rsqrt()
        penalty = self._residuals(theta, seen, penalised).flatten() * scale
        slopes = self._residual_slopes(theta, seen, penalised).flatten(0, 1) * scale

        rows = along.flatten(0, 1)
        normal = (rows.mT @ rows + slopes.mT @ slopes).double()
        gradient = (rows.mT @ flat.flatten() - slopes.mT @ penalty).double()
        cross = along.mT @ through  # [B, p, n]
        own, pull = through.mT @ through, (through.mT @ flat[..., None])
        solved = _solve(own, torch.cat([cross.mT, pull], -1))  # [B, n, p + 1]
        wide = cross.transpose(1, 2).flatten(0, 1)
        normal = normal - (wide.mT @ solved[..., :-1].flatten(0, 1)).double()
        gradient = gradient - torch.einsum("bpn,bn->p", cross, solved[..., -1]).double()
        diagonal = normal.diagonal().clamp_min(1e-9 * normal.diagonal().max())
        cost = flat.square().sum() + penalty.square().sum()
        for _ in range(8):
            delta, info = torch.linalg.solve_ex(normal + damping * diagonal.diag(), gradient)
            change = delta.to(theta.dtype)
            candidate = theta + change
            moved = starts + solved[..., -1] - solved[..., :-1] @ change
            after = self.errors(self.paths(candidate, moved, windows), windows) / sigma
            left = self._residuals(candidate, seen, penalised) * scale
            if info == 0 and after.square().sum() + left.square().sum() < cost:
                return candidate, moved, max(damping / 5.0, 1e-10), True
            damping = min(damping * 4.0, 1e8)
        return theta, self.settle(theta, starts, windows, sigma), damping, False


class _Step(torch.nn.Module):
    """A step of the model as a forward pass, for derivatives by its parameters."""

    def __init__(self, loss: DynamicsLoss) -> None:
        super().__init__()
        self.dynamics = loss.dynamics

    def forward(self, state: Tensor, action: Tensor, seconds: Tensor) -> Tensor:
        return self.dynamics.step(state, action, seconds)


def _solve(normal: Tensor, right: Tensor) -> Tensor:
    """Solve small positive systems ``[B, n, n]``, with a little of their diagonal for safety."""
    diagonal = normal.diagonal(dim1=-2, dim2=-1)
    ridge = 1e-6 * diagonal.clamp_min(1e-6 * diagonal.amax(-1, keepdim=True) + 1e-30)
    return torch.linalg.solve(normal + ridge.diag_embed(), right)
