"""How sure a fit is of the constants of the prior, and draws of what it leaves open."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.func import jacrev, vmap

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics.ensemble import EnsembleResidual
from phihp_torchrl.dynamics.least_squares import LeastSquares
from phihp_torchrl.dynamics.loss import DynamicsLoss
from phihp_torchrl.dynamics.members import member_loss
from phihp_torchrl.dynamics.prior import PhysicsPrior

_CONSTANTS = "dynamics.prior.log_constants"
_GUESS_STD = 1.0
"""Std of every parameter before the data: one e-fold of a free constant."""
_INTERVAL = 1.96
"""Half-width of a 95 % interval, in standard deviations."""

_ROUNDING = 1e-12
"""Least mean square of errors, in units of a step, that numbers of single precision can have."""


@torch.no_grad()
def constants_covariance(
    loss: DynamicsLoss, train: TensorDictBase, held_out: TensorDictBase, *, rows: int = 2000
) -> Tensor:
    r"""Covariance of the parameters of the prior's learned constants, after a fit.

    .. math::
        H^{-1} \left(\sum_i J_i^\top \Omega J_i\right) H^{-1}, \qquad
        H = \sum_i J_i^\top J_i + \frac{1}{\lambda} \sum_i K_i^\top K_i + \rho I

    with the Jacobians J of the errors and K of F^r by all parameters, those of the residual too, so
    that a constant which the residual can make up for is an unsure one. :math:`\Omega` is the
    second moment of the errors of held-out transitions, which a network that follows its data too
    closely does not make small, and which counts a position and its velocity once if their errors
    are one.
    :math:`\rho` keeps a standard deviation below a half. A combination of constants on which these
    data have no bearing at all has no variance: its draws would change no prediction of the data.

    Errors that go together in time, and those by which the model's form is wrong, make the truth
    less sure than this says.

    Args:
        loss: the loss of the fitted model, with the scales and λ of its fit. Of an ensemble, the
            first member is meant, with which the constants were fitted.
        train: the transitions ``[N]`` that were fitted.
        held_out: held-out transitions ``[M]``.
        rows: most transitions of ``train`` that are differentiated, evenly spaced; the sums are
            scaled up to all of them.

    Returns:
        ``[learned, learned]``, in the order of :attr:`PhysicsPrior.learned` and in units of their
        parameters: of a free constant the logarithm, so that a root is a relative error.

    Raises:
        ConfigError: for a model without learned constants, or with an integrator that cannot be
            differentiated row by row.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import DynamicsLoss, HybridDynamics, get_task
        >>> task = get_task("cartpole")
        >>> state, action = task.coverage.sample([64]), 2 * torch.rand(64, 1) - 1
        >>> loss = DynamicsLoss(HybridDynamics.hybrid(task))
        >>> following = TensorDict(observation=task.observe(loss.dynamics(state, action)))
        >>> data = TensorDict(
        ...     observation=task.observe(state), action=action, next=following, batch_size=[64]
        ... ).detach()
        >>> covariance = constants_covariance(loss, data, data)
        >>> covariance.shape[0] == len(loss.dynamics.prior.learned)
        True
    """
    prior = loss.dynamics.prior
    if not isinstance(prior, PhysicsPrior) or not prior.learned:
        raise ConfigError("dynamics", "expected a model with learned constants, got one without.")
    if not loss.dynamics.integrator.compiles:
        raise ConfigError(
            "integrator",
            "expected one with fixed steps, which differentiates row by row, "
            f"got {loss.dynamics.integrator.name!r}.",
        )
    if isinstance(loss.dynamics.residual, EnsembleResidual):
        loss = member_loss(loss, 0)
    system = LeastSquares(loss)
    theta = system.vector.read().double()
    chosen = train[torch.arange(len(train))[:: -(-len(train) // rows)]]
    share = len(chosen) / len(train)
    transitions = [part.double() for part in loss.transitions(chosen)]
    penalised = transitions[1].roll(len(chosen) // 2, 0)  # as the fit's: actions of other rows
    clock = loss.time_step(chosen)
    measured = (*transitions, penalised, *(() if clock is None else (clock.double(),)))
    differentiate = vmap(jacrev(system.row), (None, *[0] * len(measured)))
    parts = zip(*(x.split(200) for x in measured), strict=True)
    jacobian = torch.cat([differentiate(theta, *part) for part in parts])
    size = loss.dynamics.task.system.state_dim
    error = loss.prediction_error(*loss.transitions(held_out), loss.time_step(held_out)).detach()
    error = (error / loss.error_scale).double()
    omega = error.mT @ error / len(error)
    weighted = torch.einsum("nip,ij->njp", jacobian[:, :size], _root(omega)).flatten(0, 1)
    every = jacobian.flatten(0, 1)
    ridge = omega.diagonal().mean().clamp_min(_ROUNDING) / _GUESS_STD**2
    identity = torch.eye(len(theta)).to(theta)
    bread = every.mT @ every / share + ridge * identity
    first = list(system.vector.named).index(_CONSTANTS)
    start = sum(system.vector.sizes[:first])
    columns = torch.linalg.solve(bread, identity[:, start : start + system.vector.sizes[first]])
    swayed = weighted @ columns
    return (swayed.mT @ swayed / share).float()


def draw_shifts(covariance: Tensor, count: int, generator: torch.Generator | None = None) -> Tensor:
    """Draw shifts of parameters from the 95 % interval of each of their principal directions.

    Args:
        covariance: covariance of the parameters, ``[c, c]``.
        count: number of draws.
        generator: source of randomness. Defaults to torch's global generator.

    Returns:
        Shifts ``[count, c]`` about 0, normal and cut off at the ends of the interval.

    Examples:
        >>> draw_shifts(torch.tensor([[0.04]]), 1000).abs().max() <= 1.96 * 0.2
        tensor(True)
    """
    draws = torch.empty(count, len(covariance), dtype=torch.float64)
    torch.nn.init.trunc_normal_(draws, a=-_INTERVAL, b=_INTERVAL, generator=generator)
    values, vectors = torch.linalg.eigh(covariance.double())
    return (draws * values.clamp_min(0.0).sqrt() @ vectors.mT).to(covariance.dtype)


def _root(matrix: Tensor) -> Tensor:
    """A root R of a covariance, ``R @ R.mT``, singular or not."""
    values, vectors = torch.linalg.eigh(matrix)
    return vectors * values.clamp_min(0.0).sqrt()
