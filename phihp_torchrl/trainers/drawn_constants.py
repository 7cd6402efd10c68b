"""Constants of the imagined worlds, drawn from the interval that the fit of the model leaves."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import HybridDynamics, PhysicsPrior, draw_shifts
from phihp_torchrl.trainers.policy_config import PolicyConfig


def draw_constants(
    dynamics: HybridDynamics, config: PolicyConfig, covariance: Tensor | None, seed: int
) -> Tensor | None:
    """Shifts of the constants of each imagined world, ``[worlds, learned]``, if there are any.

    Args:
        dynamics: the model.
        config: settings of the phase.
        covariance: covariance of the model's learned constants, used without
            ``config.constants_std``.
        seed: seed of the draws.

    Raises:
        ConfigError: for a model without learned constants, and without a covariance.
    """
    if not config.draw_constants:
        return None
    prior = getattr(dynamics, "prior", None)
    if not isinstance(prior, PhysicsPrior) or not prior.learned:
        raise ConfigError(
            "policy.draw_constants", "expected false for a model without learned constants."
        )
    if config.constants_std is not None:
        covariance = config.constants_std**2 * torch.eye(len(prior.learned))
    if covariance is None:
        raise ConfigError(
            "policy.draw_constants",
            "expected the covariance of the constants, or policy.constants_std, got neither.",
        )
    # The draws have a generator of their own, so that everything else is as without them.
    return draw_shifts(covariance, config.num_worlds, torch.Generator().manual_seed(seed))
