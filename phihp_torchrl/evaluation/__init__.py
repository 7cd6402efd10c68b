"""What an agent is worth: returns, latency, pictures and tables."""

from __future__ import annotations

from phihp_torchrl.evaluation.curve import (
    CurvePoint,
    curve_from_metrics,
    read_curve,
    write_curve,
)
from phihp_torchrl.evaluation.episode import Episode, play_episode
from phihp_torchrl.evaluation.figures import draw_learning_curves, episode_figure, learning_curve
from phihp_torchrl.evaluation.latency import Latency, measure_latency
from phihp_torchrl.evaluation.prediction import (
    PREDICTION_EPISODES,
    PREDICTION_STEPS,
    UnseenEpisodes,
    prediction_errors,
    unseen_episodes,
)
from phihp_torchrl.evaluation.published import (
    DEFAULT_SAMPLES,
    PUBLISHED,
    PUBLISHED_SAMPLES,
    PUBLISHED_UPDATES,
    TARGETS,
    Published,
)
from phihp_torchrl.evaluation.returns import (
    Evaluation,
    PairedDifference,
    evaluate,
    paired_difference,
)
from phihp_torchrl.evaluation.seeds import EVALUATION_SEED, check_training_seed, evaluation_seed
from phihp_torchrl.evaluation.table import TaskResult, markdown_table, mean_and_std, returns_table
from phihp_torchrl.evaluation.video import write_gif

__all__ = [
    "DEFAULT_SAMPLES",
    "EVALUATION_SEED",
    "PREDICTION_EPISODES",
    "PREDICTION_STEPS",
    "PUBLISHED",
    "PUBLISHED_SAMPLES",
    "PUBLISHED_UPDATES",
    "TARGETS",
    "CurvePoint",
    "Episode",
    "Evaluation",
    "Latency",
    "PairedDifference",
    "Published",
    "TaskResult",
    "UnseenEpisodes",
    "check_training_seed",
    "curve_from_metrics",
    "draw_learning_curves",
    "episode_figure",
    "evaluate",
    "evaluation_seed",
    "learning_curve",
    "markdown_table",
    "mean_and_std",
    "measure_latency",
    "paired_difference",
    "play_episode",
    "prediction_errors",
    "read_curve",
    "returns_table",
    "unseen_episodes",
    "write_curve",
    "write_gif",
]
