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
        ["acrobot, phihp, 1000", "1", "1", "102", "–"],
        ["cartpole, phihp, 1000", "1", "1", "–", "3"],
        ["pendulum, phihp, 1000", "2", "2", "–", "–"],
    ]
