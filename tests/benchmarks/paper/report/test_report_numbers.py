"""The numbers of a report, by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from kept_runs import make, make_run, results, table
from scipy import stats

from measures import DEFAULT_SAMPLES, Between, difference, holm, ratio_interval
from phihp_torchrl import get_task, load_config
from report import (
    BOUNDS,
    NOT_RUN,
    normalise,
    published_difference,
    read_run,
    samples_to_90,
)
from report.ablation import ablation
from report.aggregate import aggregates, profiles, score_matrix
from report.curves import mean_over_tasks, sample_curves, update_curves
from report.efficiency import learning_points, sample_efficiency
from report.learning_curve import learning_curve
from report.paper_systems import PHIHP, TD3, TD3_IM_PH, system
from report.planner_and_actor import acting_section, returns_markdown, usual_groups
from report.results import SIX_TASKS, Results
from report.runs import Acting
from report.time_to_return import seconds_to


def test_bounds_are_what_the_rewards_give_at_rest() -> None:
    for name, steps in (("pendulum", 200), ("pendulum-swingup", 500), ("acrobot-swingup", 500)):
        task = get_task(name)
        assert task.max_steps == steps
        worst = torch.zeros(task.system.state_dim)
        best = worst.clone()
        (worst if "pendulum" in name else best)[0] = math.pi
        action = torch.zeros(task.system.action_dim)
        for state, bound in zip((worst, best), BOUNDS[name], strict=True):
            reward = task.reward(state, action, state)
            assert steps * float(reward) == pytest.approx(bound, rel=1e-5, abs=1e-4)
    assert normalise("cartpole", 250.0) == 0.5
    with pytest.raises(ValueError, match="task: expected one of"):
        normalise("my-task", 0.0)


def test_samples_to_90_percent() -> None:
    assert samples_to_90([(100, 449.0), (200, 450.0), (300, 500.0)]) == Between(100, 200)
    assert samples_to_90([(100, -111.0), (200, -110.0), (300, -100.0)]) == Between(100, 200)
    assert samples_to_90([(100, -5.0)]) == Between(0, 100)


def test_a_policy_from_a_model_has_a_point_for_each_number_of_samples(tmp_path: Path) -> None:
    # The actor's evaluations during training all come after the last real step.
    curve = ((200, -900.0), (200, -300.0))
    make_run(tmp_path, samples=200, curve=curve)
    make_run(tmp_path, samples=1000, acting={"planner": [-120.0], "actor": [-150.0]})
    found = results(tmp_path)
    few, many = found.scores(PHIHP, "pendulum")
    assert learning_points(few) == [(200, -185.0)]
    assert learning_points(many) == [(1000, -120.0)]
    assert sample_efficiency(found, PHIHP, "pendulum") == Between(200, 1000)
    assert sample_curves(found, (PHIHP, TD3), "pendulum") == {
        "PhIHP": [((200, 1000), (-185.0, -120.0))]
    }
    # The planner's score counts for PhIHP, the actor's for TD3-im-ph: one run gives both.
    assert [score.mean for score in found.usual(TD3_IM_PH, "pendulum")] == [-150.0]
    assert update_curves(found, "pendulum") == {}
    assert len(update_curves(results(tmp_path), "cartpole")) == 0


def test_a_policy_from_real_steps_has_a_curve(tmp_path: Path) -> None:
    curve = ((1000, -900.0), (20000, -205.0), (30000, -199.0))
    make_run(tmp_path, "td3", samples=30000, curve=curve, acting={"actor": [-200.0]}, kind=None)
    found = results(tmp_path)
    (score,) = found.scores(TD3, "pendulum")
    assert score.run.kind is None
    # The last point is the final evaluation.
    assert learning_points(score) == [(1000, -900.0), (20000, -205.0), (30000, -200.0)]
    assert sample_efficiency(found, TD3, "pendulum") == Between(1000, 20000)
    assert update_curves(found, "pendulum") == {
        "TD3": [([0.0, 10.0, 20.0], [-900.0, -205.0, -199.0])]
    }


def test_an_own_run_goes_before_the_part_of_another(tmp_path: Path) -> None:
    make_run(tmp_path, "phihp")
    make_run(tmp_path, "td3-im-ph", acting={"actor": [-1.0]})
    assert [score.mean for score in results(tmp_path).scores(TD3_IM_PH, "pendulum")] == [-1.0]


def test_a_cem_without_samples(tmp_path: Path) -> None:
    make_run(tmp_path, "cem-oracle", samples=0, kind="oracle", acting={"planner": [-200.0]})
    assert sample_efficiency(results(tmp_path), system("cem-oracle"), "pendulum") == Between(0, 0)


def test_the_mean_over_tasks_starts_where_all_have_a_return() -> None:
    steps, values = mean_over_tasks(
        {
            "cartpole": {0: [(0, 100.0), (50, 500.0)], 1: [(10, 300.0)]},
            "acrobot": {0: [(20, -500.0), (60, 0.0)]},
        }
    )
    assert steps.tolist() == [20, 50, 60]
    assert values.tolist() == pytest.approx([0.2, 0.4, 0.9])


def test_a_difference_against_numbers_worked_by_hand() -> None:
    # Means 2 and 5, variances 1 and 4: t = -3 / sqrt(1/3 + 4/3), about 2.94 degrees of freedom.
    found = difference([1.0, 2.0, 3.0], [3.0, 5.0, 7.0])
    assert found is not None
    assert found.mean == pytest.approx(-3.0)
    error, freedom = math.sqrt(5 / 3), (5 / 3) ** 2 / ((1 / 3) ** 2 / 2 + (4 / 3) ** 2 / 2)
    half = stats.t.ppf(0.975, freedom) * error
    assert (found.low, found.high) == pytest.approx((-3 - half, -3 + half))
    assert found.p == pytest.approx(2 * stats.t.sf(3 / error, freedom))
    assert found.within(10.0)
    assert not found.within(3.5)


def test_there_is_no_p_value_of_few_seeds_or_without_spread() -> None:
    assert difference([], [1.0]) is None
    one = difference([1.0], [2.0, 3.0])
    assert one is not None
    assert math.isnan(one.low)
    assert not one.within(100.0)
    two = difference([1.0, 2.0], [5.0, 6.0, 7.0])
    assert two is not None
    assert two.low < two.mean < two.high
    assert math.isnan(two.p)
    assert not two.within(100.0), "two seeds are equivalent to nothing"
    equal = difference([500.0] * 3, [500.0] * 3)
    assert equal is not None
    assert math.isnan(equal.p)
    assert equal.within(5.0)
    apart = difference([500.0] * 3, [400.0] * 3)  # an infinite t is none
    assert apart is not None
    assert math.isnan(apart.p)
    assert not apart.within(5.0)


def test_the_published_difference() -> None:
    published = published_difference("acrobot-swingup", "TD3")
    assert published is not None
    assert published.mean == 371 - 119
    t = published.mean / math.sqrt((52**2 + 71**2) / 10)
    assert published.low > 0
    assert published.p == pytest.approx(2 * stats.t.sf(t, 16.5), rel=0.1)
    assert published_difference("cartpole-swingup", "TD3") is None


def test_holm_adjusts_a_family_and_leaves_out_what_was_not_tested() -> None:
    nan = math.nan
    assert holm([0.04, nan, 0.01]) == pytest.approx([0.04, nan, 0.02], nan_ok=True)
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


def test_aggregates_and_profiles_against_numpy() -> None:
    pytest.importorskip("rliable")
    matrix = np.array([[0.1, 0.5], [0.2, 0.6], [0.3, 0.7], [0.4, 0.8]])
    one = aggregates({"x": matrix}, reps=200)["x"]
    assert one.values[0] == pytest.approx(np.median(matrix.mean(0)))
    assert one.values[2] == pytest.approx(matrix.mean())
    assert one.values[3] == pytest.approx(1 - matrix.mean())
    assert one.values[1] == pytest.approx(np.sort(matrix.ravel())[2:-2].mean())
    assert (one.low <= one.values).all()
    assert (one.values <= one.high).all()
    assert (one.low < one.high).all()
    # The same draws each time, and NumPy's own go on as if there had been none.
    np.random.seed(3)
    before = np.random.get_state()[1].tolist()
    again = aggregates({"y": matrix, "x": matrix}, reps=200)["x"]
    assert again.low.tolist() == one.low.tolist()
    assert np.random.get_state()[1].tolist() == before
    middle, low, high = profiles({"x": matrix}, np.array([0.0, 0.45, 0.9]), reps=50)["x"]
    assert middle.tolist() == [1.0, 0.5, 0.0]
    assert (low <= middle).all()
    assert (middle <= high).all()


def test_a_matrix_has_as_many_seeds_as_all_tasks_have(tmp_path: Path) -> None:
    for seed in range(3):
        make_run(tmp_path, task="cartpole", seed=seed, acting={"planner": [500.0], "actor": [0.0]})
    make_run(tmp_path, task="acrobot", acting={"planner": [-250.0], "actor": [0.0]})
    matrix = score_matrix(results(tmp_path), PHIHP, ("cartpole", "acrobot"))
    assert matrix is not None
    assert matrix.tolist() == [[1.0, 0.5]]
    assert score_matrix(results(tmp_path), PHIHP, ("cartpole", "pendulum")) is None


def test_one_seed_at_other_samples_moves_no_comparison(tmp_path: Path) -> None:
    """Neither to the default preset's number of samples nor to more."""
    for seed in range(3):
        make_run(tmp_path, samples=200, seed=seed)
    for samples in (1000, 2000):
        make_run(tmp_path, samples=samples)
    found = results(tmp_path)
    assert [score.run.samples for score in found.usual(PHIHP, "pendulum")] == [200] * 3
    assert {task: len(runs) for task, runs in usual_groups(found.runs).items()} == {"pendulum": 3}


def test_a_run_whose_calibration_lets_the_actor_act_is_left_out_nowhere(tmp_path: Path) -> None:
    folder = make_run(tmp_path, acting={"planner": [-100.0], "actor": [-140.0]}, ms=5.0)
    timed = json.loads((folder / "evaluation.json").read_text())
    timed["planner"]["latency_ms_p50"] = 0.1  # where a plan serves many actions it is not the mean
    (folder / "evaluation.json").write_text(json.dumps(timed))
    make_run(tmp_path, seed=1, acting={"actor": [-120.0]}, ms=1.0)
    make_run(tmp_path, "td-mpc-star", acting={"actor": [-300.0]})
    found = results(tmp_path)
    assert [score.mean for score in found.usual(PHIHP, "pendulum")] == [-100.0, -120.0]
    assert found.has_run(system("td-mpc-star"), "pendulum")
    matrix = score_matrix(found, PHIHP, ("pendulum",))
    assert matrix is not None
    assert matrix.shape == (2, 1)
    (gain,) = (
        acting_section(found.runs).tables["What planning adds to the actor, the same episodes"].rows
    )
    assert [str(cell) for cell in (gain[2], gain[-1])] == ["20.00", "2"]
    (times,) = acting_section(found.runs).tables["Time"].rows
    assert [str(cell) for cell in times[-2:]] == ["5.0 (1)", "3.0 ± 2.8 (2)"]
    assert "| pendulum | 2 | 1000 | −110.0 ± 14.1 | −130.0 ± 14.1 |" in returns_markdown(found.runs)


def test_the_interval_of_a_ratio_is_wide_where_seeds_differ() -> None:
    alike = ratio_interval([Between(500, 600)] * 3, [Between(50, 100)] * 3)
    assert (alike.low, alike.high) == (5.0, 12.0)
    apart = ratio_interval([Between(100, 100), Between(500, 500), Between(900, 900)],
                           [Between(0, 100)] * 3)  # fmt: skip
    assert apart.low < 5.0
    assert apart.high == math.inf


def test_the_default_presets_samples_go_before_more(tmp_path: Path) -> None:
    for samples, earned in ((200, -300.0), (1000, -200.0), (2000, -100.0)):
        make_run(tmp_path, samples=samples, acting={"actor": [earned], "planner": [earned]})
    make_run(tmp_path, method="td3", samples=30_000, kind=None, acting={"actor": [-150.0]})
    found = results(tmp_path)
    assert [score.mean for score in found.usual(PHIHP, "pendulum")] == [-200.0]
    assert [score.mean for score in found.usual(TD3, "pendulum")] == [-150.0]


def test_the_default_preset_takes_the_samples_that_reports_think() -> None:
    for task, samples in DEFAULT_SAMPLES.items():
        assert load_config(task)["model"]["real_steps"] == samples, task


def test_seconds_to_a_return(tmp_path: Path) -> None:
    """During training by the clock of the curve, at the end by all of it, else never."""
    curve = ((1000, -900.0), (1000, -300.0), (1000, -150.0))
    run = read_run(make_run(tmp_path, curve=curve))
    assert seconds_to(run, -300.0) == 1.0
    assert seconds_to(run, -200.0) == 2.0
    last = read_run(make_run(tmp_path, seed=1, curve=curve[:1]))
    assert seconds_to(last, -200.0) == 30.0
    assert seconds_to(last, -100.0) == math.inf
    plans = {"planner": Acting((-90.0,), {}), "actor": Acting((-300.0,), {})}
    seconds = {**last.seconds, "calibrate": 5.0}
    assert seconds_to(replace(last, acting=plans, seconds=seconds), -100.0) == 35.0


def test_an_average_is_of_one_share_of_the_published_samples(tmp_path: Path) -> None:
    for task, samples in DEFAULT_SAMPLES.items():
        for seed in (0, 1, 2):
            make_run(tmp_path / "half", "dd-phihp", task, seed, samples, kind="data_driven")
    twin = system("dd-phihp")
    found = results(tmp_path / "half").averaged(twin)
    assert found is not None
    assert [len(scores) for scores in found] == [3] * 6
    assert results(tmp_path / "half").samples_note(twin, "pendulum") == ""
    for seed in range(2, 7):  # pendulum is known best at 20 samples, though a half was run too
        make_run(tmp_path / "few", "dd-phihp", "pendulum", seed, 20, kind="data_driven")
    runs = [run for run in results(tmp_path / "half").runs if run.task != "pendulum"]
    mixed = Results([*runs, *results(tmp_path / "few").runs])
    assert mixed.averaged(twin) is None
    assert score_matrix(mixed, twin, SIX_TASKS) is None
    assert mixed.samples_note(twin, "pendulum") == "20 samples"
    assert "(5; 20 samples)" in str(ablation(mixed).tables["By task"].markdown())


def test_an_agent_of_which_the_actor_alone_was_evaluated_has_its_curve(tmp_path: Path) -> None:
    """Whatever calibration chose for it at the end."""
    found = []
    for seed, acting in enumerate(({"planner": [9.0], "actor": [5.0]}, {"actor": [5.0]})):
        curve = ((100, 0.0), (200, 5.0), (300, 5.0))
        make_run(tmp_path, "td-mpc-star", seed=seed, samples=300, curve=curve, acting=acting)
    for score in results(tmp_path).scores(system("td-mpc-star"), "pendulum"):
        found.append(learning_points(score))
    assert found == [[(100, 0.0), (200, 5.0), (300, 5.0)]] * 2


def test_time_to_the_published_return_against_published_updates(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    make_run(runs, curve=((1000, -900.0), (1000, -200.0)))
    make_run(runs, seed=1, curve=((1000, -900.0),))
    make_run(runs, task="cartpole", acting={"planner": [9.0, 9.0], "actor": [8.0, 8.0]})
    rows = [["fused step, compiled", "2.0", "1.00"]]
    timed = tmp_path / "benchmarks.json"
    timed.write_text(json.dumps({"A TD3 update of 64 transitions": {"rows": rows}}))
    make(tmp_path, runs, benchmarks=str(timed))
    pendulum, cartpole = table(tmp_path, "time_to_return")
    assert float(pendulum["median s to it"]) == pytest.approx((1.0 + 30.0) / 2)
    assert float(pendulum["published updates, s"]) == pytest.approx(1000.0)
    assert float(pendulum["times our s to it"]) == pytest.approx(1000.0 / 15.5)
    assert cartpole["reached by"] == "0 of 1"
    assert cartpole["median s to it"] == cartpole["times our s to it"] == NOT_RUN
    make(tmp_path, runs, benchmarks=str(tmp_path / "none.json"))
    assert table(tmp_path, "time_to_return")[0]["published updates, s"] == NOT_RUN


def test_learning_curve(tmp_path: Path) -> None:
    one = ([0, 100, 200], [0.0, 1.0, 2.0])
    two = ([0, 100, 300], [2.0, 3.0, 5.0])
    figure = learning_curve({"PhIHP": [one, two]}, reference={"paper": 1.5}, title="pendulum")
    axis = figure.axes[0]
    mean = axis.lines[2]
    assert mean.get_xdata().tolist() == [0, 100, 200]
    assert mean.get_ydata().tolist() == [1.0, 2.0, 2.5]  # a return stays what it was
    assert axis.get_xscale() == "linear"
    wide = learning_curve({"a": [([10, 1000], [0, 1])], "b": [([], [])]})
    assert wide.axes[0].get_xscale() == "symlog"
    for i, drawn in enumerate((figure, wide, learning_curve({}))):
        drawn.savefig(tmp_path / f"{i}.png")


def test_seeds_that_were_run_at_fewer_numbers_do_not_widen_the_samples(tmp_path: Path) -> None:
    """Three seeds have a point at 100 samples; the fourth was run at 1000 alone."""
    for seed in (0, 1, 2, 3):
        make_run(tmp_path, seed=seed, samples=1000, acting={"planner": [-100.0]})
    assert sample_efficiency(results(tmp_path), system("phihp"), "pendulum") is None
    for seed in (0, 1, 2):
        make_run(tmp_path, seed=seed, samples=100, acting={"planner": [-101.0]})
        found = sample_efficiency(results(tmp_path), system("phihp"), "pendulum")
    assert str(found) == "≤ 100"
    # What two of them were run with besides is no point of theirs, nor of the curve.
    for seed in (0, 1):
        make_run(tmp_path, seed=seed, samples=2000, acting={"planner": [-1.0]})
    found = results(tmp_path)
    assert str(sample_efficiency(found, system("phihp"), "pendulum")) == "≤ 100"
    curves = sample_curves(found, [system("phihp")], "pendulum")["PhIHP"]
    assert [list(samples) for samples, _ in curves] == [[100, 1000]] * 3
