"""A model in which every imagined life has a residual and constants of its own."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics.ensemble import EnsembleResidual
from phihp_torchrl.dynamics.hybrid import HybridDynamics
from phihp_torchrl.dynamics.prior import PhysicsPrior


def per_life(dynamics: HybridDynamics, shifts: Tensor | None = None) -> HybridDynamics:
    """Return a view of a model in which each row of a batch is another model that the data allow.

    Row ``i`` of a batch (counted through all its dimensions) moves by member ``i mod members`` of
    the ensemble and by constants ``i mod draws``. Imagination keeps a life in its row, so that a
    life has one model from its start to its end, as a life in the world has; errors of models that
    changed at every step would average out over a life. Nothing is added to the state, and nothing
    is drawn in a step.

    The view shares the parameters of ``dynamics``, which itself stays the mean model, for planning.

    Args:
        dynamics: the model.
        shifts: additions ``[draws, learned]`` to the parameters of the prior's learned constants
            (:class:`PhysicsPrior`), such as :func:`draw_shifts` makes; ``None`` for none.

    Returns:
        The view, or ``dynamics`` itself if all rows would be the same.

    Raises:
        ConfigError: for shifts of the wrong shape, or of a prior that learns no constants.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> dynamics = HybridDynamics.hybrid(get_task("pendulum"), ensemble=2)
        >>> state, action = torch.zeros(3, 2), torch.ones(3, 1)
        >>> first, second, again = per_life(dynamics)(state, action)
        >>> bool((first == again).all()), bool((first == second).all())
        (True, False)
    """
    # A model of one's own kind, without these parts, is the same in all rows.
    prior, residual = (getattr(dynamics, part, None) for part in ("prior", "residual"))
    if isinstance(residual, EnsembleResidual) and residual.members > 1:
        residual = _RowResidual(residual)
    if shifts is not None:
        if not isinstance(prior, PhysicsPrior) or not prior.learned:
            raise ConfigError("shifts", "expected none for a model without learned constants.")
        if shifts.dim() != 2 or not len(shifts) or shifts.shape[1] != len(prior.learned):
            raise ConfigError(
                "shifts",
                f"expected a tensor of shape [draws, {len(prior.learned)}], "
                f"got {list(shifts.shape)}.",
            )
        prior = _RowPrior(prior, shifts)
    if not isinstance(prior, _RowPrior) and not isinstance(residual, _RowResidual):
        return dynamics
    return HybridDynamics(
        dynamics.task, prior=prior, residual=residual, integrator=dynamics.integrator
    )


class _RowResidual(nn.Module):
    """F^r of a row's member."""

    def __init__(self, ensemble: EnsembleResidual) -> None:
        super().__init__()
        self.ensemble = ensemble

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        members, batch, size = self.ensemble.members, state.shape[:-1], state.shape[-1]
        each = self.ensemble.each(state, action).reshape(members, -1, size)
        row = torch.arange(each.shape[1], device=state.device)
        return each[row % members, row].reshape(*batch, size)


class _RowPrior(nn.Module):
    """F^p with a row's constants."""

    shifts: Tensor

    def __init__(self, prior: PhysicsPrior, shifts: Tensor) -> None:
        super().__init__()
        self.prior = prior
        self.register_buffer("shifts", shifts.to(prior.log_constants))

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return self.prior.system.prior(state, action, self._constants(state))

    def impulse(self, pair: int, state: Tensor) -> Tensor:
        position = tuple(self.prior.system.velocity_of)[pair]
        return self.prior.system.impulse(position, state, self._constants(state))

    def _constants(self, state: Tensor) -> dict[str, Tensor]:
        """The constants of each row, ``[*batch]``."""
        batch = state.shape[:-1]
        row = torch.arange(batch.numel(), device=state.device).reshape(batch) % len(self.shifts)
        drawn = self.prior.decode(self.prior.log_constants + self.shifts)
        return {name: value[row] if value.dim() else value for name, value in drawn.items()}
