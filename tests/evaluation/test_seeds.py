"""Evaluation and training share no seed."""

from __future__ import annotations

import pytest

from phihp_torchrl.evaluation import EVALUATION_SEED, check_training_seed, evaluation_seed


def test_evaluation_and_training_share_no_seed():
    assert evaluation_seed() == EVALUATION_SEED == 1_000_000
    assert evaluation_seed(7) == 1_000_007
    assert check_training_seed(999_999) == 999_999
    for seed in (-1, EVALUATION_SEED, evaluation_seed(3)):
        with pytest.raises(ValueError, match="seed: expected 0 to 999999"):
            check_training_seed(seed)
    with pytest.raises(ValueError, match="k: expected"):
        evaluation_seed(-1)
