"""Seeds of evaluation, which differ from those of training."""

from __future__ import annotations

from phihp_torchrl.config import ConfigError

EVALUATION_SEED = 1_000_000
"""The first seed of evaluation; training and the choice of actors use smaller seeds."""


REPORT_SEED = 100
"""The first training seed for reports; those before are for tuning."""

PROOF_SEED = 2_000_200
"""The first seed of the episodes that are kept for a last proof: no report looks at them before."""


def evaluation_seed(k: int = 0) -> int:
    """Return the ``k``-th seed of evaluation, which no training uses.

    Raises:
        ConfigError: for a negative number.

    Examples:
        >>> evaluation_seed(3)
        1000003
    """
    if k < 0:
        raise ConfigError("k", f"expected a number >= 0, got {k}.")
    return EVALUATION_SEED + k


def check_training_seed(seed: int) -> int:
    """Return ``seed`` if training may use it.

    Raises:
        ConfigError: for a negative seed, and for a seed of evaluation.

    Examples:
        >>> check_training_seed(3)
        3
    """
    if not 0 <= seed < EVALUATION_SEED:
        raise ConfigError(
            "seed",
            f"expected 0 to {EVALUATION_SEED - 1} (later ones are for evaluation), got {seed}.",
        )
    return seed
