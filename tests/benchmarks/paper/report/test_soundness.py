"""What a report says of runs that do not fit together."""

from __future__ import annotations

import json
from pathlib import Path

from kept_runs import make_run, results

from report.soundness import soundness


def test_cells_of_one_configuration_and_fresh_seeds_are_sound(tmp_path: Path) -> None:
    for seed in (100, 101):
        make_run(tmp_path, seed=seed)
    section = soundness(results(tmp_path).runs)
    assert "That is so." in section.text
    assert not section.tables


def test_other_settings_changed_code_and_seen_seeds_are_named(tmp_path: Path) -> None:
    make_run(tmp_path, seed=100)
    other = make_run(tmp_path, seed=101)
    config = other / "config.yaml"
    config.write_text(config.read_text() + "policy: {updates: 7}\n")
    dirty = make_run(tmp_path, task="acrobot", seed=102)
    metadata = json.loads((dirty / "metadata.json").read_text())
    metadata["sessions"][0]["dirty"] = True
    (dirty / "metadata.json").write_text(json.dumps(metadata))
    make_run(tmp_path, task="cartpole", seed=3)
    make_run(tmp_path, "td3", seed=104, samples=9)
    section = soundness(results(tmp_path).runs)
    assert "not so in 3 of 4 cells" in section.text
    rows = [[str(cell) for cell in row] for row in section.tables["Cells"].rows]
    assert rows == [
        ["acrobot, phihp, 1000", "1", "1", "0123456", "102", "–", "–"],
        ["cartpole, phihp, 1000", "1", "1", "0123456", "–", "–", "3"],
        ["pendulum, phihp, 1000", "2", "2", "0123456", "–", "–", "–"],
    ]


def resumed(folder: Path, commit: str, dirty: bool | None) -> None:
    """Another session of a run."""
    metadata = json.loads((folder / "metadata.json").read_text())
    metadata["sessions"].append({**metadata["sessions"][0], "commit": commit, "dirty": dirty})
    (folder / "metadata.json").write_text(json.dumps(metadata))


def test_every_session_of_a_run_is_looked_at(tmp_path: Path) -> None:
    same = "0123456789abcdef"
    resumed(make_run(tmp_path, task="acrobot", seed=100), "fedcba9876543210", False)
    resumed(make_run(tmp_path, task="cartpole", seed=100), same, True)
    resumed(make_run(tmp_path, task="pendulum", seed=100), same, None)
    resumed(make_run(tmp_path, "td3", task="pendulum", seed=100), same, False)
    rows = soundness(results(tmp_path).runs).tables["Cells"].rows
    assert [[str(cell) for cell in row[3:6]] for row in rows] == [
        ["0123456, fedcba9", "–", "–"],
        ["0123456", "100", "–"],
        ["0123456", "–", "100"],
    ]


def test_only_bookkeeping_of_a_run_itself_is_free(tmp_path: Path) -> None:
    """A setting of the same name elsewhere, as the seed of a world, is one like any other."""
    for seed in (100, 101):
        config = make_run(tmp_path, seed=seed) / "config.yaml"
        config.write_text(config.read_text() + f"world: {{kind: simulated, seed: {seed}}}\n")
        config = make_run(tmp_path, "td3", seed=seed) / "config.yaml"
        config.write_text(config.read_text() + f"evaluate: {{video: {seed == 100}}}\n")
    (row,) = soundness(results(tmp_path).runs).tables["Cells"].rows
    assert [str(cell) for cell in row[:3]] == ["pendulum, phihp, 1000", "2", "2"]
