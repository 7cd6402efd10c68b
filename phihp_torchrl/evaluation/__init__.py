"""Evaluation of agents: returns, latency, pictures and tables."""

from __future__ import annotations

from phihp_torchrl.evaluation.beside import BASELINES_KEY, controllers_table, play_baselines
from phihp_torchrl.evaluation.episode import Episode, play_episode
from phihp_torchrl.evaluation.figures import Curve, episode_figure
from phihp_torchrl.evaluation.latency import Latency, measure_latency
from phihp_torchrl.evaluation.predicted import EVERY, Predictions, predict_episode
from phihp_torchrl.evaluation.published import PUBLISHED, TARGETS, Published
from phihp_torchrl.evaluation.returns import AT_ONCE, Evaluation, evaluate
from phihp_torchrl.evaluation.seeds import (
    EVALUATION_SEED,
    PROOF_SEED,
    REPORT_SEED,
    check_training_seed,
    evaluation_seed,
)
from phihp_torchrl.evaluation.show import show_episode
from phihp_torchrl.evaluation.slow_plans import warn_of_slow_plans
from phihp_torchrl.evaluation.table import TaskResult, markdown_table, mean_and_std, returns_table
from phihp_torchrl.evaluation.video import write_gif
from phihp_torchrl.evaluation.violations import Violations

__all__ = [
    "Episode",
    "Evaluation",
    "Violations",
    "episode_figure",
    "evaluate",
    "evaluation_seed",
    "measure_latency",
    "play_episode",
    "show_episode",
    "write_gif",
]
