"""A report on disk becomes a task."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from phihp_torchrl.config import ConfigError
from phihp_torchrl.identification import Identification, identified_task
from phihp_torchrl.identification.parts import (
    COMBINED,
    NOT_IDENTIFIED,
    ActuatorEstimate,
    Estimate,
)
from phihp_torchrl.tasks import get_task

TASK = get_task("pendulum")


@pytest.fixture
def report(tmp_path):
    found = Identification(
        constants={
            "length": Estimate(1.0, 1.2, 1.1, 1.3),
            "mass": Estimate(1.0, 1.0, verdict=NOT_IDENTIFIED),
        },
        combinations={},
        actuator=ActuatorEstimate(delay_steps=2.0, lag_s=0.1),
        errors={},
        regions=(),
        noise={},
        warnings=(),
        data={"step_s": TASK.time_step},
    )
    found.save(tmp_path / "identification.json")
    return tmp_path


def test_constants_and_actuator_are_those_of_the_report(report):
    task = identified_task(TASK, report)
    assert task.system.constants["length"] == 1.2
    assert (task.actuator.delay_steps, task.actuator.lag) == (2.0, 0.1)
    assert not any(c.fixed for c in task.system.ranges.values())


def test_what_is_identified_can_be_kept(report):
    task = identified_task(TASK, report / "identification.json", fixed=True)
    kept = {name for name, c in task.system.ranges.items() if c.fixed}
    assert kept == {"length"} | {n for n, c in TASK.system.ranges.items() if c.fixed}
    assert not TASK.system.ranges["length"].fixed


def test_nothing_to_keep_is_said(report, caplog):
    path = report / "identification.json"
    plain = json.loads(path.read_text())
    identified_task(TASK, path, fixed=True)
    assert not caplog.records
    plain["constants"]["length"]["verdict"] = COMBINED + "mass"
    path.write_text(json.dumps(plain))
    identified_task(TASK, path)
    assert not caplog.records
    task = identified_task(TASK, path, fixed=True)
    assert not task.system.ranges["length"].fixed
    assert "fixed=True fixes no constant of pendulum" in caplog.text
    assert "to fit length, mass" in caplog.text


def test_a_delay_is_counted_in_steps_of_the_task(report):
    slow = replace(TASK, time_step=2.0 * TASK.time_step)
    assert identified_task(slow, report).actuator.delay_steps == pytest.approx(1.0)


@pytest.mark.parametrize(
    "text", ["{}", "no JSON", json.dumps({"constants": {"x": 1}}), "[]"], ids=str
)
def test_what_is_no_report_is_refused(text, tmp_path):
    (tmp_path / "identification.json").write_text(text)
    with pytest.raises(ConfigError, match=r"report: expected an identification\.json"):
        identified_task(TASK, tmp_path)
    with pytest.raises(ConfigError, match="report"):
        identified_task(TASK, tmp_path / "absent.json")


def test_constants_of_another_system_are_refused(report):
    with pytest.raises(ConfigError, match="has the constant 'length'"):
        identified_task(get_task("cartpole"), report)
