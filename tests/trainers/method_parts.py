"""The smallest run of each method."""

from __future__ import annotations

from dataclasses import replace

from phihp_torchrl.config import METHODS, YAML
from phihp_torchrl.tdmpc import ScheduledMPPIConfig, TDMPCConfig, TDMPCTrainConfig, TOLDConfig
from phihp_torchrl.trainers import RunConfig

from .run_parts import CALIBRATE, CONFIG, EVALUATE, MODEL, POLICY
from .trainer_parts import REAL

TASKS = sorted(path.stem for path in (YAML / "task").glob("*.yaml"))
TDMPC = TDMPCTrainConfig(
    real_steps=50,
    seed_steps=25,
    updates_per_step=0.2,
    horizon=3,
    batch_size=4,
    replay_capacity=60,
    evaluation_interval=30,
    evaluation_episodes=2,
    learn=TDMPCConfig(told=TOLDConfig(latent_dim=4, encoder_dim=8, mlp_dim=8)),
    planner=ScheduledMPPIConfig(
        planning_horizon=2,
        optim_steps=1,
        num_candidates=8,
        top_k=2,
        num_policy_candidates=2,
        schedule_steps=40,
    ),
)


def small(method: str, task: str = CONFIG.task) -> RunConfig:
    """The smallest run of a method."""
    chosen = METHODS[method]
    model = MODEL
    if chosen.model_kind is not None:
        oracle = chosen.model_kind == "oracle"
        model = replace(model, kind=chosen.model_kind, real_steps=0 if oracle else 60)
    planner = CONFIG.planner
    if chosen.acting == "plain_planner":
        planner = replace(planner, num_policy_candidates=0, replan_every=2)
    sections = {
        "model": model,
        "policy": POLICY,
        "td3": REAL,
        "tdmpc": TDMPC,
        "calibrate": CALIBRATE,
        "evaluate": EVALUATE,
    }
    return replace(
        CONFIG, task=task, method=method, phases=None, planner=planner, sections=sections
    )
