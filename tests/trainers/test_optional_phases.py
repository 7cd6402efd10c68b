"""A phase that is switched off is none of a run's, so runs from before it go on as they were."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from phihp_torchrl import load_config
from phihp_torchrl.config import ConfigError, compose_yaml, get_method
from phihp_torchrl.trainers import CalibrateConfig, read_run_config, run
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.run_request import read_request

from .run_parts import CONFIG, forget_settings, rows, with_sections

WITHOUT = ("model", "policy", "evaluate")
ON = CalibrateConfig(enabled=True, episodes=2, max_episodes=2, budget=1)


def age(path: Path) -> None:
    """Leave a run's settings as they were written before there was the phase."""
    file = path / "config.yaml"
    settings = OmegaConf.load(file)
    del settings["calibrate"]
    assert list(settings["phases"]) == list(WITHOUT)
    OmegaConf.save(settings, file)
    forget_settings(path)


# Settings


def test_switched_off_it_is_not_among_the_phases() -> None:
    off = [load_config("pendulum", preset="paper")]
    off.append(load_config("pendulum", overrides=["calibrate.enabled=false"]))
    for config in map(read_run_config, off):
        assert config.section("calibrate").enabled is False
        assert config.phases_to_do == config.phases == WITHOUT
    assert read_run_config(load_config("pendulum")).phases_to_do == get_method("phihp").phases


def test_its_switch_decides_and_it_need_not_be_named() -> None:
    everything = get_method("phihp").phases
    assert replace(CONFIG, phases=everything).phases == WITHOUT
    on = with_sections(CONFIG, calibrate=ON)
    assert on.phases == replace(on, phases=WITHOUT).phases == everything
    assert replace(on, phases=("policy", "evaluate"), start_from="x").phases == everything[1:]
    assert replace(on, phases=("evaluate",), start_from="x").phases_before == everything[:3]
    with pytest.raises(ConfigError, match=r"^phases: expected consecutive ones of .*'calibrate'"):
        replace(on, phases=("model", "evaluate"))


def test_to_name_it_switched_off_is_an_error_that_says_what_to_do() -> None:
    options: dict[str, Any] = {"phases": ("calibrate", "evaluate"), "start_from": "x"}
    with pytest.raises(ConfigError, match=r"^calibrate\.enabled: expected true, for phases="):
        replace(CONFIG, **options)


# Runs from before


def test_a_run_from_before_the_phase_resumes(whole: Path, tmp_path: Path) -> None:
    """All but the last phase is done."""
    older = tmp_path / "older"
    shutil.copytree(whole, older)
    shutil.rmtree(older / "phases" / "evaluate")
    (older / "evaluation.json").unlink()
    age(older)
    words = [f"resume={older}"]
    asked = read_request(compose_yaml(words), words)
    assert asked.config.phases_to_do == WITHOUT
    assert run(asked.config, asked.path, resume=True).finished
    assert rows(older) == rows(whole)
    assert {path.name for path in (older / "phases").iterdir()} == set(WITHOUT)


@pytest.mark.parametrize("enabled", [False, True])
def test_to_evaluate_a_run_from_before_needs_no_such_phase(
    whole: Path, tmp_path: Path, enabled: bool, caplog: pytest.LogCaptureFixture
) -> None:
    older = tmp_path / "older"
    shutil.copytree(whole, older)
    age(older)
    later = replace(CONFIG, phases=("evaluate",), start_from=str(older))
    if enabled:
        later = with_sections(later, calibrate=ON)
    with caplog.at_level(logging.WARNING, "phihp_torchrl.trainers.start"):
        assert run(later, tmp_path / "later").finished
    ours, theirs = (
        json.loads((path / "evaluation.json").read_text())["planner"]["returns"]
        for path in (tmp_path / "later", whole)
    )
    assert ours == theirs
    assert not (tmp_path / "later" / "calibration.json").exists()
    assert ("begin with it: phases=[calibrate, evaluate]" in caplog.text) is enabled
    kept = RunDirectory(tmp_path / "later").read_config()
    assert kept["calibrate"]["enabled"] is False


def test_what_another_run_has_calibrated_is_taken_over(whole: Path, tmp_path: Path) -> None:
    on = with_sections(CONFIG, calibrate=ON)
    run(replace(on, phases=("calibrate",), start_from=str(whole)), tmp_path / "begun")
    assert (tmp_path / "begun" / "calibration.json").exists()
    later = replace(CONFIG, phases=("evaluate",), start_from=str(tmp_path / "begun"))
    assert run(later, tmp_path / "later").finished
    agent = json.loads((tmp_path / "later" / "agent" / "agent.json").read_text())
    table = json.loads((tmp_path / "begun" / "calibration.json").read_text())
    assert agent["metadata"]["acting"] == table["acting"]
