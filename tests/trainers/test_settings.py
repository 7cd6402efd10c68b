"""The settings of the phases: what is out of range is refused by its name."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from phihp_torchrl import load_config
from phihp_torchrl.agents import RefitConfig, TD3Config
from phihp_torchrl.config import ConfigError
from phihp_torchrl.trainers import (
    CollectConfig,
    EvaluateConfig,
    ModelConfig,
    PolicyConfig,
    read_run_config,
)

from .method_parts import TASKS
from .trainer_parts import REAL


@pytest.mark.parametrize(
    ("make", "name", "value"),
    [
        (ModelConfig, "real_steps", 0),
        (ModelConfig, "steps_per_iteration", 0),
        (ModelConfig, "refit_steps", 0),
        (ModelConfig, "kind", "none"),
        (ModelConfig, "activation", "step"),
        (ModelConfig, "residual_outputs", "some"),
        (ModelConfig, "constants_error", 1.5),
        (ModelConfig, "integrator", "euler"),
        (ModelConfig, "lambda_0", -1.0),
        (ModelConfig, "tau_ph", -1.0),
        (ModelConfig, "hidden_sizes", ()),
        (ModelConfig, "substeps", 0),
        (EvaluateConfig, "episodes", 0),
        (EvaluateConfig, "latency_actions", -1),
        (EvaluateConfig, "latency_actions", 10**18),
        (EvaluateConfig, "episodes", 10**18),
        (CollectConfig, "noise", -0.1),
        (CollectConfig, "noise", math.nan),
        (CollectConfig, "random_hold", 0),
        (PolicyConfig, "updates", 0),
        (PolicyConfig, "batch_size", 0),
        (PolicyConfig, "num_worlds", 0),
        (PolicyConfig, "chunk_steps", 0),
        (PolicyConfig, "updates_per_step", 0),
        (PolicyConfig, "replay_capacity", 0),
        (PolicyConfig, "evaluation_interval", 0),
        (PolicyConfig, "evaluation_episodes", 0),
        (PolicyConfig, "random_fraction", 1.5),
        (PolicyConfig, "random_fraction", math.nan),
        (PolicyConfig, "decay", -0.5),
        (PolicyConfig, "random_steps", -1),
        (PolicyConfig, "exploration_noise", -0.1),
        (PolicyConfig, "real_evaluation_episodes", -1),
        (PolicyConfig, "max_age", 0),
        (PolicyConfig, "evaluation_steps", 0),
        (PolicyConfig, "max_seconds", 0.0),
        (PolicyConfig, "evaluation_interval", 501),
    ],
)
def test_config_errors_name_the_key(make, name, value):
    with pytest.raises(ConfigError, match=f"^{name}:"):
        make(**{name: value})


def test_chunks_hold_whole_updates():
    with pytest.raises(ConfigError, match="policy_delay"):
        PolicyConfig(chunk_steps=1, updates_per_step=3)


def test_fits_of_critics_fall_on_evaluations():
    with pytest.raises(ConfigError, match=r"^refit\.interval: expected a multiple of evaluation"):
        PolicyConfig(evaluation_interval=300, refit=RefitConfig(start=600, interval=500))
    # Without fits, or with one at the end, there is nothing to fall on them.
    for refit in (RefitConfig(interval=0), RefitConfig(start=0, interval=500)):
        PolicyConfig(evaluation_interval=300, refit=refit)


def test_periods():
    assert ModelConfig(real_steps=5000).period == 500
    assert ModelConfig(real_steps=5000).iterations == 10
    assert ModelConfig(real_steps=120).period == 50
    assert ModelConfig(real_steps=120).iterations == 3
    assert ModelConfig(real_steps=2000, steps_per_iteration=300).iterations == 7


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"real_steps": 0}, "real_steps"),
        ({"real_steps": 61}, "real_steps: expected a multiple"),
        ({"evaluation_interval": 3}, "evaluation_interval: expected a multiple"),
        ({"random_steps": 61}, "random_steps: expected at most 60"),
        ({"replay_capacity": 10}, "random_steps: expected at most 10"),
        ({"value_expansion": 5}, "value_expansion: expected 1"),
        ({"exploration_noise": -1.0}, "exploration_noise"),
        ({"decay": 2.0}, "decay"),
        ({"gamma": 1.5}, "gamma"),
    ],
)
def test_td3_on_real_steps_names_what_is_wrong(change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        replace(REAL, **change)


def test_it_is_td3s_own_configuration() -> None:
    """The published numbers are those of TD3 in imagination, as the paper stresses."""
    assert isinstance(REAL, TD3Config)
    published = read_run_config(load_config(method="td3", preset="paper")).section("td3")
    imagined = read_run_config(load_config(preset="paper")).section("policy").td3
    for name, value in vars(imagined).items():
        assert getattr(published, name) == value
    assert (published.batch_size, published.random_steps) == (64, 10_000)
    assert (published.real_steps, published.replay_capacity) == (500_000, 1_000_000)


# The papers' settings of baselines


def test_the_settings_of_cem_oracle_are_the_papers() -> None:
    for task in TASKS:
        ours = read_run_config(load_config(task, method="cem-oracle"))
        model, plan = ours.section("model"), ours.planner
        assert (ours.method, model.kind, model.real_steps) == ("cem-oracle", "oracle", 0)
        assert (plan.num_candidates, plan.top_k, plan.optim_steps) == (700, 20, 3)
        assert (plan.planning_horizon, plan.replan_every) == (30, 5)


def test_the_settings_of_tdmpc_are_the_papers() -> None:
    """The paper's table; 537 candidates are 512 at random and 25 of the policy."""
    for task in TASKS:
        ours = read_run_config(load_config(task, method="td-mpc", preset="paper"))
        assert (ours.method, ours.preset) == ("td-mpc", "paper")
        section = ours.section("tdmpc")
        plan = section.planner
        rate = 1e-4 if task in ("cartpole", "acrobot") else 1e-3
        assert (section.learn.learning_rate, section.learn.critic_learning_rate) == (1e-3, rate)
        assert (section.batch_size, section.learn.told.mlp_dim) == (512, 512)
        assert (section.learn.tau, section.learn.target_interval) == (0.01, 2)
        assert (section.seed_steps, section.replay_capacity) == (5000, 10**6)
        assert (section.priority_alpha, section.priority_beta) == (0.6, 0.4)
        assert (plan.num_candidates, plan.num_policy_candidates, plan.top_k) == (537, 25, 64)
        assert (plan.optim_steps, plan.planning_horizon, section.horizon) == (6, 5, 5)
        default = read_run_config(load_config(task, method="td-mpc")).section("tdmpc")
        assert default.learn.critic_learning_rate == rate


def test_the_method_goes_over_the_task_where_it_says_something() -> None:
    ours = read_run_config(load_config("acrobot", method="ph-cem", overrides=["planner.top_k=7"]))
    assert (ours.planner.top_k, ours.planner.num_candidates) == (7, 700)
    assert ours.section("model").hidden_sizes == (16, 16, 16)  # the task's, left alone


@pytest.mark.parametrize("value", [-1, 3.5, math.inf, "mine.py", {"x": 1.0}])
def test_plugins_are_a_list(value):
    with pytest.raises(ConfigError, match=r"^plugins: expected a list of files or modules"):
        read_run_config({**load_config("pendulum"), "plugins": value})


@pytest.mark.parametrize("key", ["method", "planner.kind", "world.kind"])
def test_a_kind_is_a_text(key):
    settings = load_config("pendulum")
    section, _, name = key.rpartition(".")
    (settings[section] if section else settings)[name] = [math.nan]
    with pytest.raises(ConfigError, match=rf"^{key}: expected one of .*, got \[nan\]"):
        read_run_config(settings)
