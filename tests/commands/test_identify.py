"""``phihp identify``: from a log or from steps to a report, and what stops it."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from phihp_torchrl.recordings import read_recordings
from phihp_torchrl.tasks import get_task

from .conftest import Command

PLAIN = (
    "identify.delay=0",
    "identify.lag=0",
    "identify.slew=0",
    "identify.dead_zone=0",
    "identify.gain_low=1",
    "identify.integrator=semi_implicit_euler",
    "identify.substeps=1",
    "identify.windows=12",
    "identify.horizons=[1,5]",
)
"""A fit of the constants alone."""

STEPS = (
    "task=pendulum",
    "steps=200",
    "world.friction={joint: 0.0}",
    "world.constants={length: 1.1}",
)

LOGGED = """
from dataclasses import replace
from phihp_torchrl import get_task, register_task
register_task(replace(get_task("pendulum"), name="logged"))
"""

COLUMNS = """# @package _global_
task: logged
columns:
  time: {column: ms, unit: ms}
  theta: {column: deg, unit: deg}
  torque: thrust
"""


@pytest.fixture(autouse=True)
def _brief_episodes() -> None:
    """Here episodes keep their length: the constants are found from whole swings."""


def failed(phihp: Command, *words: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        phihp("identify", *words)
    return str(stopped.value)


def test_from_steps_and_again_from_the_log_that_they_left(
    phihp: Command, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    phihp("identify", *STEPS, "out_dir=run", *PLAIN)
    told = capsys.readouterr().out
    assert "pendulum, identified from 200 steps in simulated" in told
    assert "only in combination with" in told
    assert 'default_constants = {\n    "gravity"' in told
    for file in ("steps.csv", "identification.json", "identification.html"):
        assert f"wrote run/{file}" in told
    found = json.loads((place / "run/identification.json").read_text())
    torque = found["combinations"]["torque_gain"]  # 3 / (m l^2)
    assert torque["estimate"] == pytest.approx(3.0 / 1.21, rel=1e-3)
    assert torque["low"] <= torque["estimate"] <= torque["high"]
    assert found["data"]["read"]["rows"] == 201
    assert set(found["errors"]) == {"1", "5"}
    page = (place / "run/identification.html").read_text()
    assert "pendulum, identified from 200 steps in simulated" in page

    words = ("task=pendulum", "world=recorded", "world.files=run/steps.csv")
    phihp("identify", *words, "out_dir=again", *PLAIN)
    again = json.loads((place / "again/identification.json").read_text())
    assert again["constants"] == found["constants"]
    assert "identified from recordings" in capsys.readouterr().out


def test_steps_are_kept_where_a_fit_fails(phihp: Command, place: Path) -> None:
    """Ten steps are too few for two windows."""
    told = failed(phihp, "task=pendulum", "steps=10", "seed=3", "out_dir=run", *PLAIN)
    assert told.startswith("error: ")
    assert "task=pendulum" in told
    assert "identify.windows=12 " in told
    assert told.endswith("world=recorded world.files=run/steps.csv")
    assert "seed=3" not in told
    data = read_recordings(get_task("pendulum"), place / "run/steps.csv")
    assert data.transitions == 10
    assert not (place / "run/identification.json").exists()


@pytest.mark.usefixtures("registries")
def test_a_task_names_the_columns_of_its_logs(phihp: Command, place: Path) -> None:
    rows = ["ms,deg,push", *(f"{50 * k},{k % 3},{(-1) ** k}" for k in range(12))]
    (place / "log.csv").write_text("\n".join(rows))
    (place / "settings/task").mkdir(parents=True)
    (place / "settings/task/logged.yaml").write_text(COLUMNS)
    (place / "my_log.py").write_text(LOGGED)
    words = ["task=logged", "plugins=[my_log.py]", "--config-dir", "settings"]
    words += ["world=recorded", "world.files=log.csv"]
    told = failed(phihp, *words)
    assert "columns.torque" in told
    assert "'thrust'" in told
    assert "['deg', 'ms', 'push']" in told
    told = failed(phihp, *words, "world.columns={torque: push}", *PLAIN)
    assert told.startswith("error: recordings: expected at least two windows")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("world=recorded", "world.files=none/*.csv"), r"^error: world.files: .*none"),
        (("world=recorded",), r"^error: .*files"),
        (("world=nowhere",), "^error: world: expected one of .*'nowhere'"),
        (("identify.delai=2",), "^error: identify.delai: unknown key; did you mean 'delay'"),
        (("identify.delay=-1",), "^error: identify.delay: expected"),
        (("steps=0",), "^error: steps: expected a whole number >= 1"),
        (("stepz=9",), "^error: stepz: unknown key; did you mean 'steps'"),
        (("model.collect.random_hold=0",), "^error: model.collect.random_hold: expected"),
    ],
)
def test_a_wrong_word_is_one_sentence_before_any_step(
    phihp: Command, place: Path, words: tuple[str, ...], message: str
) -> None:
    told = failed(phihp, "task=pendulum", *words)
    assert re.search(message, told), told
    assert not (place / "outputs").exists()


def test_a_bad_cell_names_file_line_and_column(phihp: Command, place: Path) -> None:
    (place / "log.csv").write_text("time,theta,theta_dot,torque\n0,0,0,0\n0.05,oops,0,0\n")
    told = failed(phihp, "task=pendulum", "world=recorded", "world.files=log.csv")
    for part in ("log.csv", "line 3", "theta", "oops"):
        assert part in told


def test_the_task_is_known_where_the_world_knows_it(phihp: Command, place: Path) -> None:
    told = failed(
        phihp, "world=gymnasium", "world.id=Pendulum-v1", "steps=9", "out_dir=run", *PLAIN
    )
    assert "task=pendulum" in told
    assert (place / "run/steps.csv").read_text().count("\n") == 11


def test_help_needs_no_torch() -> None:
    code = (
        "import sys; from phihp_torchrl.commands import main; main(['identify', '--help']); "
        "sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "identify.delay=auto" in done.stdout
