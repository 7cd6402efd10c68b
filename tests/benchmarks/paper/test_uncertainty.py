"""Gain and cost of uncertainty: settings, intervals by training seed, tables of what there is."""

from __future__ import annotations

import json

import pytest

from phihp_torchrl import load_config
from phihp_torchrl.trainers import read_run_config
from uncertainty import NARROW, RESULTS, VARIANTS, cost, gains, settings, write_tables

ORIGIN = {
    "commit": "5e6e490c0ffee",
    "dirty": False,
    "machine": {"cpus": 2, "memory_gib": 23.5, "gpus": 0},
}


def made(variant, seed, planner, seconds=10.0, task="pendulum-swingup"):
    return {
        "task": task,
        "variant": variant,
        "seed": seed,
        "settings": settings(task, variant, seed, 100),
        "real_steps": 250,
        "returns": {"planner": planner, "actor": [value - 1.0 for value in planner]},
        "metrics": {},
        "cost": {"fits": seconds, "update": 0.5 * seconds},
        "seconds": {"model": seconds, "policy": seconds, "evaluate": 99.0},
        "wall_seconds": 100.0,
        "origin": ORIGIN,
    }


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_variant_is_a_run_with_a_tenth_of_the_samples(variant):
    lines = settings("pendulum-swingup", variant, 100, None)
    config = read_run_config(load_config("pendulum-swingup", overrides=lines))
    default = read_run_config(load_config("pendulum-swingup"))
    assert config.section("model").real_steps * 10 == default.section("model").real_steps
    assert config.section("policy").updates == default.section("policy").updates
    assert config.section("model").ensemble == (5 if variant in ("ensemble", "both") else 1)
    assert config.section("policy").draw_constants == (variant in ("constants", "both"))


def test_updates_are_a_limit():
    assert "policy.updates=300" in settings("pendulum-swingup", "plain", 100, 300)
    assert settings("pendulum", "plain", 100, 10**9) == settings("pendulum", "plain", 100, None)


def test_narrow_networks_are_settings_that_the_table_names():
    lines = settings("acrobot", "plain", 100, None, NARROW)
    td3 = read_run_config(load_config("acrobot", overrides=lines)).section("policy").td3
    assert (td3.actor_hidden_sizes, td3.critic_hidden_sizes) == ((128, 128), (128, 128, 128))
    (row,) = gains([made("plain", 100, [1.0]) | {"settings": lines}], "planner")
    assert row[5] == "narrow"


def test_a_gain_is_taken_seed_by_seed():
    # Seeds differ by 100, the variants by 2 and 4: what the seeds share cancels.
    runs = [made("plain", 100, [0.0, 2.0]), made("plain", 101, [100.0, 102.0])]
    runs += [
        made("both", 100, [2.0, 4.0], seconds=30.0),
        made("both", 101, [104.0, 106.0], seconds=30.0),
    ]
    plain, both = gains(runs, "planner")
    assert plain[:6] == ["pendulum-swingup", "plain", "2", "250", "100", "default"]
    assert plain[6] == "51.0 ± 635.3"
    assert plain[7:] == ["", "", ""]
    assert both[7:] == ["3.0 ± 12.7", "3.00", "3.00"]


def test_an_update_costs_what_it_does_once_all_is_compiled():
    points = [(100.0, 10), (120.0, 20), (140.0, 30), (190.0, 40)]  # 10 s an update, then 2, 2, 5
    rows = [{"model/fit_seconds": "1.5"}, {"model/fit_seconds": "2.5"}]
    rows += [{"policy/seconds": str(t), "policy/updates": str(n)} for t, n in points]
    assert cost(rows) == {"fits": 4.0, "update": 2.0}


def test_a_variant_without_plain_runs_has_no_gain():
    (row,) = gains([made("both", 100, [1.0])], "planner")
    assert row[6:] == ["1.0 one seed", "", "", ""]


def test_the_tables_hold_what_the_files_hold(tmp_path):
    for seed in (100, 101):
        for variant in ("plain", "ensemble"):
            run = made(variant, seed, [1.0, 2.0])
            (tmp_path / f"{variant}-{seed}.json").write_text(json.dumps(run))
    write_tables(tmp_path)
    text = (tmp_path / "README.md").read_text()
    row = "| ensemble | 2 | 250 | 100 | default | 1.5 ± 0.0 | 0.0 ± 0.0 | 1.00 | 1.00 |"
    assert row in text
    assert "Training seeds: 100, 101. Commits: 5e6e490." in text
    assert "both |" not in text
    assert "constants |" not in text


def test_what_is_published_is_what_the_script_writes(tmp_path):
    """The committed table is made from the committed files."""
    runs = sorted(RESULTS.glob("*.json"))
    if not runs:
        pytest.skip("no run is kept yet")
    for path in runs:
        (tmp_path / path.name).write_text(path.read_text())
    write_tables(tmp_path)
    assert (tmp_path / "README.md").read_text() == (RESULTS / "README.md").read_text()
