"""Curves, predictions, paired returns and samples, by hand."""

from __future__ import annotations

import math

import pytest
import torch

from measures import (
    PREDICTION_EPISODES,
    PREDICTION_STEPS,
    PUBLISHED_SAMPLES,
    curve_from_metrics,
    paired_difference,
    prediction_errors,
    read_curve,
    unseen_episodes,
    write_curve,
)
from phihp_torchrl import ConfigError, HybridDynamics
from phihp_torchrl.evaluation import PUBLISHED, TARGETS
from phihp_torchrl.tasks import list_tasks
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld


def test_paired_difference():
    a, b = torch.tensor([3.0, 5.0, 4.0]), torch.tensor([1.0, 1.0, 1.0])
    difference = paired_difference(a, b)
    assert difference.mean == pytest.approx(3.0)
    assert difference.standard_error == pytest.approx(1 / math.sqrt(3))
    assert not difference.is_worse
    assert paired_difference(b, a).is_worse
    assert not paired_difference(a, a).is_worse
    assert not paired_difference(torch.tensor([0.0, 9.0]), torch.tensor([1.0, 9.0])).is_worse
    for bad in (torch.ones(2), torch.ones(3, 1)):
        with pytest.raises(ValueError, match="returns_a, returns_b: expected"):
            paired_difference(a, bad)


def test_published_numbers_fit_together():
    assert set(PUBLISHED) <= set(PUBLISHED_SAMPLES) <= set(list_tasks())
    assert set(TARGETS) < set(PUBLISHED_SAMPLES)
    for task, row in PUBLISHED.items():
        assert set(row) == {"PhIHP", "TD-MPC", "TD3", "CEM-oracle"}
        assert row["PhIHP"].samples * 1000 == PUBLISHED_SAMPLES[task]
    assert PUBLISHED["acrobot-swingup"]["PhIHP"][:2] == (371, 52)
    assert "cartpole-swingup" not in PUBLISHED, "its reward is another than the published one"
    with pytest.raises(TypeError):
        PUBLISHED["pendulum"] = {}


def test_a_curve_is_every_evaluation_in_the_real_world(tmp_path):
    row = {"phase": "policy", "real_steps": "60", "seconds": "1.5"}
    rows = [
        {**row, "phase": "model", "collect/reward": "-1"},
        {**row, "policy/updates": "10", "policy/imagined_steps": "640", "policy/real_return": "-9"},
        {**row, "policy/updates": "20", "policy/real_return": "-inf"},
        {**row, "td3/updates": "30", "return_mean": "-8", "return_std": "2", "loss": ""},
        {**row, "tdmpc/planner_return": "-7", "tdmpc/actor_return": "-6",
         "tdmpc/episode_return": "0"},
        {**row, "evaluate/planner/return_mean": "-5", "evaluate/planner/return_std": "1",
         "evaluate/planner/episodes": "50", "evaluate/actor/return_mean": ""},
    ]  # fmt: skip
    curve = curve_from_metrics(rows)
    assert [(p.acting, p.return_mean, p.updates) for p in curve[1:]] == [
        ("actor", -8, 30),
        ("planner", -7, 30),
        ("actor", -6, 30),
        ("planner", -5, 30),
    ]
    assert (curve[0].return_mean, curve[0].updates, curve[0].imagined_steps) == (-9, 10, 640)
    assert (curve[1].return_std, curve[4].return_std, curve[4].episodes) == (2, 1, 50)
    assert math.isnan(curve[2].return_std)
    write_curve(tmp_path / "curve.csv", curve)
    assert str(read_curve(tmp_path / "curve.csv")) == str(curve)  # NaN is not NaN
    (tmp_path / "curve.csv").write_text("real_steps,return_mean\n1,2\n")
    with pytest.raises(ValueError, match=r"curve\.csv: expected the columns"):
        read_curve(tmp_path / "curve.csv")


def test_predictions_are_judged_on_states_of_their_own():
    world = SimulatedWorld("acrobot")
    start, actions, end = unseen_episodes(world, "coverage")
    assert start.shape == end.shape == (PREDICTION_EPISODES, 4)
    assert actions.shape == (PREDICTION_EPISODES, PREDICTION_STEPS, 1)
    assert torch.equal(start, unseen_episodes(world, "coverage").start)
    right = prediction_errors(world, world.oracle())
    wrong = prediction_errors(world, HybridDynamics.hybrid(world.task))
    assert right["reset_mean"] < 1e-4 < wrong["reset_mean"]
    assert right["coverage_median"] < 1e-2 < wrong["coverage_median"]
    other = SimulatedWorld("acrobot", SimulatedConfig(integrator="rk4", substeps=2))
    assert prediction_errors(other, world.oracle())["reset_mean"] > 1e-3, "the truth is the world's"
    with pytest.raises(ConfigError, match="where: expected a box"):
        unseen_episodes(world, "nowhere")
