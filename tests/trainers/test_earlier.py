"""Going on from a run whose task or world was another one."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import get_task
from phihp_torchrl.trainers import run
from phihp_torchrl.trainers.earlier import check_earlier
from phihp_torchrl.trainers.run_config import task_of
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.start import begin
from phihp_torchrl.worlds import RecordedConfig, SimulatedWorld
from tests.followed import disturbed, followed

from .run_parts import CONFIG, forget_settings

TASK = get_task("brief-pendulum")
OTHERS: list[tuple[dict[str, Any], str]] = [
    ({"actuator": {"delay_steps": 1}}, r"^actuator: expected none, .*got .*delay_steps"),
    ({"action_rate_limit": 20.0}, r"^action_rate_limit: expected none, .*got "),
    ({"action_rate_cost": 0.5}, r"^action_rate_cost: expected none, .*got 0\.5"),
    (
        {"constraints": {"theta_dot": {"high": 6.0, "price": 1.0}}},
        r"^constraints: expected none, .*got .*6\.0",
    ),
]


@pytest.mark.parametrize("described", [True, False])
@pytest.mark.parametrize(("changes", "message"), OTHERS)
def test_a_task_with_other_settings_is_refused(
    changes: dict[str, Any], message: str, described: bool, whole: Path, tmp_path: Path
) -> None:
    source = Path(shutil.copytree(whole, tmp_path / "source"))
    if not described:
        (source / "metadata.json").unlink()  # as of a run of an earlier version
    later = replace(CONFIG, phases=("evaluate",), start_from=str(source), **changes)
    with pytest.raises(ConfigError, match=message):
        run(later, tmp_path / "later")
    assert not (tmp_path / "later").exists()


def test_a_policy_is_learned_anew_at_other_prices(whole: Path) -> None:
    limits = {"theta_dot": {"high": 6.0, "price": 1.0}}
    later = replace(CONFIG, phases=("policy",), start_from=str(whole), constraints=limits)
    check_earlier(later, task_of(later))
    with pytest.raises(ConfigError, match=r"^constraints: expected none"):
        check_earlier(replace(later, phases=("evaluate",)), task_of(later))
    priced = replace(CONFIG, phases=("policy",), start_from=str(whole), action_rate_cost=0.5)
    with pytest.raises(ConfigError, match=r"^from: .*registers: expected 0, .*got 1"):
        check_earlier(priced, task_of(priced))  # its states have the last action in them


def test_the_way_back_is_refused_too(tmp_path: Path) -> None:
    late = replace(CONFIG, phases=("model",), actuator={"delay_steps": 1})
    run(late, tmp_path / "late")
    later = replace(CONFIG, phases=("policy",), start_from=str(tmp_path / "late"))
    with pytest.raises(ConfigError, match=r"^actuator: expected .*delay_steps.*got none"):
        run(later, tmp_path / "later")
    same = replace(late, phases=("policy",), start_from=str(tmp_path / "late"))
    assert run(same, tmp_path / "same").finished


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (replace(TASK, time_step=0.02), r"^from: .*time_step: expected 0\.05, .*got 0\.02"),
        (replace(TASK, action_high=(1.0,)), r"^from: .*action_(low|high): expected"),
    ],
)
def test_a_task_that_was_changed_since_is_refused(task: Any, message: str, whole: Path) -> None:
    later = replace(CONFIG, phases=("evaluate",), start_from=str(whole))
    check_earlier(later, TASK)
    with pytest.raises(ConfigError, match=message):
        check_earlier(later, task)


def test_a_task_that_follows_another_reference_is_refused(tmp_path: Path) -> None:
    task = followed()
    (tmp_path / "run").mkdir()
    begin(replace(CONFIG, task=task.name), RunDirectory(tmp_path / "run"), task)
    later = replace(CONFIG, task=task.name, phases=("policy",), start_from=str(tmp_path / "run"))
    check_earlier(later, task)
    with pytest.raises(
        ConfigError, match=r"^from: .*disturbance.high.x_dot: expected none, .*got 3"
    ):
        check_earlier(later, disturbed())
    other = replace(task, reference=replace(task.reference, preview=3))
    with pytest.raises(ConfigError, match=r"^from: .*reference.preview: expected .*got 3"):
        check_earlier(later, other)


def test_the_settings_of_an_old_run_are_those_of_its_task(whole: Path, tmp_path: Path) -> None:
    source = Path(shutil.copytree(whole, tmp_path / "source"))
    forget_settings(source)
    directory = RunDirectory(source)
    settings = directory.read_config()
    for key in ("actuator", "action_rate_cost", "constraints"):
        del settings[key]
    directory.write_config(settings)
    metadata = directory.read_metadata()
    metadata.pop("task", None)
    directory.write_metadata(metadata)
    later = replace(CONFIG, phases=("evaluate",), start_from=str(source))
    check_earlier(later, task_of(later))


def test_another_world_is_told(whole: Path, caplog: pytest.LogCaptureFixture) -> None:
    later = replace(CONFIG, phases=("evaluate",), start_from=str(whole))
    with caplog.at_level(logging.WARNING):
        check_earlier(later, TASK)
        assert not caplog.records
        check_earlier(replace(later, world=RecordedConfig("a.csv")), SimulatedWorld(TASK).task)
    assert "is of world=simulated, and this one goes on in world=recorded" in caplog.text
