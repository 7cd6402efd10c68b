"""Kept runs replayed through the rule by which learning ends."""

from __future__ import annotations

import csv

import pytest

from measures import DEFAULT_SAMPLES
from plateau import DEFAULT, RESULTS, Curve, curves, main, replay, rows

STANDS = Curve(list(range(100, 1100, 100)), [0.0, 50.0] + [100.0] * 7 + [130.0])


def write_run(folder, returns):
    folder.mkdir(parents=True)
    with (folder / "metrics.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["model/loss", "policy/updates", "policy/imagined_return"])
        table.writerow([1.0, "", ""])
        table.writerows(["", f"{100.0 * k}", value] for k, value in enumerate(returns, 1))


def test_a_run_that_stands_ends_early_and_loses_what_came_later():
    end, lost = replay(STANDS, patience=0.3, tail=0.1)
    assert (end, lost) == (pytest.approx(0.7), 30.0)


def test_a_patient_rule_loses_nothing():
    assert replay(STANDS, patience=0.8, tail=0.1) == (1.0, 0.0)


def test_default_runs_are_found_and_others_are_not(tmp_path):
    write_run(tmp_path / "pendulum-default-n1000-seed0", STANDS.returns)
    write_run(tmp_path / "pendulum-default-n1000-seed1", STANDS.returns)
    write_run(tmp_path / "pendulum-td3-default-n1000-seed0", STANDS.returns)
    found = curves(tmp_path)
    assert found == {("pendulum", 1000): [STANDS, STANDS]}
    (row,) = rows(found)
    assert row[:4] == ["pendulum", "1000", "2", "130.0"]


def test_hardly_a_kept_run_would_lose_by_the_default(tmp_path):
    """One of the proof's sixty would, by this replay; the run itself went on."""
    main(["--results", str(tmp_path)])
    table = (tmp_path / "README.md").read_text().splitlines()
    published = (RESULTS / "README.md").read_text().splitlines()
    assert table[:-2] == published[:-2]  # all but the commit
    patience, tail = DEFAULT
    found = curves(RESULTS.parent / "runs")
    usual = {key: group for key, group in found.items() if key[1] == DEFAULT_SAMPLES[key[0]]}
    runs = [(key, each) for key, group in usual.items() for each in group]
    losing = [key for key, run in runs if replay(run, patience, tail)[1] > 0]
    assert losing == [("acrobot", 2500)]
