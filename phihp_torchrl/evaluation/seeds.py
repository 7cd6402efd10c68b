"""Seeds of evaluation, apart from those of training."""

from __future__ import annotations

EVALUATION_SEED = 1_000_000
"""Seeds from here on belong to evaluation; training and the choice of actors use smaller ones."""


def evaluation_seed(k: int = 0) -> int:
    """The ``k``-th seed of evaluation, which no training uses.

    Raises:
        ValueError: for a negative number.

    Examples:
        >>> evaluation_seed(3)
        1000003
    """
    if k < 0:
        raise ValueError(f"k: expected a number >= 0, got {k}.")
    return EVALUATION_SEED + k


def check_training_seed(seed: int) -> int:
    """Return ``seed`` if training may use it.

    Raises:
        ValueError: for a negative seed and for those of evaluation.
    """
    if not 0 <= seed < EVALUATION_SEED:
        raise ValueError(
            f"seed: expected 0 to {EVALUATION_SEED - 1} (later ones are for evaluation), "
            f"got {seed}."
        )
    return seed
