"""What the grid and the report measure alike: curves, predictions, paired returns, samples."""

from __future__ import annotations

from measures.acting import agent_in
from measures.censored import RESAMPLES, Between, mean_between, ratio_between, ratio_interval
from measures.configuration import configuration_hash
from measures.curve import (
    CurvePoint,
    curve_from_metrics,
    last_metrics,
    read_curve,
    write_curve,
)
from measures.differences import (
    FEWEST_SEEDS,
    Difference,
    difference,
    holm,
    mean_and_half,
    mean_of_seeds,
)
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
    "FEWEST_SEEDS",
    "PREDICTION_EPISODES",
    "PREDICTION_STEPS",
    "PUBLISHED_SAMPLES",
    "PUBLISHED_UPDATES",
    "RESAMPLES",
    "Between",
    "CurvePoint",
    "Difference",
    "PairedDifference",
    "UnseenEpisodes",
    "agent_in",
    "configuration_hash",
    "curve_from_metrics",
    "difference",
    "holm",
    "last_metrics",
    "mean_and_half",
    "mean_between",
    "mean_of_seeds",
    "paired_difference",
    "prediction_errors",
    "ratio_between",
    "ratio_interval",
    "read_curve",
    "unseen_episodes",
    "write_curve",
]
