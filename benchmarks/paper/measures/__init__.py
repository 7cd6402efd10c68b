"""What the grid and the report measure alike: curves, predictions, paired returns, samples."""

from __future__ import annotations

from measures.curve import CurvePoint, curve_from_metrics, read_curve, write_curve
from measures.paired import PairedDifference, paired_difference
from measures.prediction import (
    PREDICTION_EPISODES,
    PREDICTION_STEPS,
    UnseenEpisodes,
    prediction_errors,
    unseen_episodes,
)
from measures.samples import DEFAULT_SAMPLES, PUBLISHED_SAMPLES, PUBLISHED_UPDATES

__all__ = [
    "DEFAULT_SAMPLES",
    "PREDICTION_EPISODES",
    "PREDICTION_STEPS",
    "PUBLISHED_SAMPLES",
    "PUBLISHED_UPDATES",
    "CurvePoint",
    "PairedDifference",
    "UnseenEpisodes",
    "curve_from_metrics",
    "paired_difference",
    "prediction_errors",
    "read_curve",
    "unseen_episodes",
    "write_curve",
]
