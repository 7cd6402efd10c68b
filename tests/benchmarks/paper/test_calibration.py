"""The tables of calibration, from numbers made by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from calibration import kept_episodes


def test_only_new_episodes_are_played_where_others_are_kept(tmp_path: Path) -> None:
    path, world = tmp_path / "pendulum.json", {"given": 1, "chosen": 2, "actor": 3}
    assert kept_episodes(path, {"changes": {}}) == {}
    path.write_text(json.dumps({"changes": {"alpha": 0.5}, "world": world}))
    assert kept_episodes(path, {"changes": {"alpha": 0.5}}) == world
    assert kept_episodes(path, {"changes": {}}) == {"given": 1, "actor": 3}


def test_the_tables_pair_the_episodes_and_name_what_was_not_run(
    run_script: Callable[..., None], tmp_path: Path
) -> None:
    place = tmp_path / "results" / "calibration"
    place.mkdir(parents=True)
    found = {
        "acting": "actor",
        "certain": False,
        "way": "calm",
        "changes": {"alpha": 0.5},
        "gain": 1.0,
        "gain_error": 2.0,
        "episodes": 48,
        "ways": {
            "given": {"gain": 2.0, "gain_error": 3.0},
            "calm": {"gain": 1.0, "gain_error": 2.0},
        },
        "planner_chatter": 0.1,
        "actor_chatter": 0.0,
        "cpu_seconds": 33.3,
        "origin": "commit abc",
        "world": {
            "given": {"returns": [1.0, 2.0], "chatter": 0.41},
            "chosen": {"returns": [3.0, 6.0], "chatter": 0.11},
            "actor": {"returns": [2.0, 4.0], "chatter": 0.01},
        },
    }
    (place / "pendulum.json").write_text(json.dumps(found))
    run_script("calibration", "--only-write")
    lines = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in (place / "README.md").read_text().splitlines()
    ]
    cells = [line for line in lines if line[0] == "pendulum"]
    assert cells[0][1:5] == ["actor, in doubt", "calm: alpha=0.5", "48", "+1.00 ± 2.00"]
    assert cells[0][7] == "given +2.00 ± 3.00; calm +1.00 ± 2.00"
    # The actor acts, so the calibrated agent's episodes are the actor's.
    assert cells[1][1:7] == ["2", "1.5", "4.5", "3.0", "+1.50 ± 0.50", "+1.50 ± 0.50"]
    text = (place / "README.md").read_text()
    assert "Not run: pendulum-swingup, cartpole" in text
