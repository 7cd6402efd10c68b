"""The loss of one member of an ensemble, by which it is fitted as if it were alone."""

from __future__ import annotations

import copy
import dataclasses

from torch import Tensor, nn

from phihp_torchrl.dynamics.ensemble import EnsembleResidual
from phihp_torchrl.dynamics.hybrid import HybridDynamics
from phihp_torchrl.dynamics.loss import DynamicsLoss


def member_loss(loss: DynamicsLoss, index: int) -> DynamicsLoss:
    """The loss of a model with a single residual, a copy of member ``index``.

    The first member learns the constants of the prior, with the very parameters of ``loss``; the
    others take them as known. So there is one set of constants, and the members disagree about F^r
    alone.

    Args:
        loss: the loss of a model whose residual is an ensemble.
        index: number of the member.
    """
    whole = loss.dynamics
    assert isinstance(whole.residual, EnsembleResidual)
    prior = whole.prior
    if prior is not None and index > 0:
        prior = _Known(prior)
    one = HybridDynamics(
        whole.task,
        prior=prior,
        residual=whole.residual.member(index),
        integrator=whole.integrator,
    )
    own = DynamicsLoss(one, lambda_0=loss.lambda_0, tau_ph=loss.tau_ph)
    keys = loss.tensor_keys
    own.set_keys(**dataclasses.asdict(keys))
    for name, value in loss.named_buffers(recurse=False):
        own.get_buffer(name).copy_(value)
    return own


class _Known(nn.Module):
    """A prior whose constants are not learned: it has no parameters to be found."""

    def __init__(self, prior: nn.Module) -> None:
        super().__init__()
        self._held = (copy.deepcopy(prior).requires_grad_(False),)  # in a tuple: not registered

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        values: Tensor = self._held[0](state, action)
        return values

    def impulse(self, pair: int, state: Tensor) -> Tensor:
        change: Tensor = self._held[0].impulse(pair, state)  # type: ignore[operator]
        return change
