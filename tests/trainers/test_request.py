"""What a command line asks for: a new run, or to go on with one, also of an earlier version."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from phihp_torchrl.config import METHODS, ConfigError, compose_yaml
from phihp_torchrl.evaluation import TARGETS
from phihp_torchrl.planners import CEMConfig, MPPIConfig
from phihp_torchrl.trainers import (
    RunDirectory,
    RunRequest,
    read_request,
    read_result,
    read_run_config,
    run,
)
from phihp_torchrl.trainers.yaml_file import parse_yaml
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

from .run_parts import CONFIG, with_sections

COMMITTED = sorted((Path(__file__).parents[2] / "results" / "runs-0.1.0").iterdir())


def request(*words: str) -> RunRequest:
    return read_request(compose_yaml(words), words)


def write(config, path: Path) -> Path:
    path.mkdir()
    RunDirectory(path).write_config(config.to_mapping())
    return path


# Resuming


def test_a_resumed_run_has_its_own_settings_whatever_the_defaults(tmp_path: Path) -> None:
    place = write(CONFIG, tmp_path / "run")
    asked = request(f"resume={place}")
    assert (asked.path, asked.resume) == (str(place), True)
    assert asked.config == replace(CONFIG, phases=asked.config.phases)
    assert asked.config.section("policy").updates == 12


def test_words_go_over_the_settings_of_a_resumed_run(tmp_path: Path) -> None:
    place = write(CONFIG, tmp_path / "run")
    changed = request(f"resume={place}", "checkpoint_interval=7", "policy.updates=16").config
    assert (changed.checkpoint_interval, changed.section("policy").updates) == (7, 16)
    assert changed.section("model") == CONFIG.section("model")
    # The logger is a group: what its file says replaces all that the run had.
    logged = request(f"resume={place}", "logger=tensorboard", "logger.tags=[again]").config.logger
    assert (logged.name, logged.tags) == ("tensorboard", ("again",))
    assert request(f"resume={place}").config.logger == CONFIG.logger


def test_a_resumed_run_keeps_its_world_and_its_planner(tmp_path: Path) -> None:
    world = SimulatedConfig(integrator="rk4", friction={"joint": 0.7})
    planner = MPPIConfig(num_candidates=16, top_k=4, num_policy_candidates=2)
    place = write(replace(CONFIG, world=world, planner=planner), tmp_path / "run")
    asked = request(f"resume={place}").config
    assert (asked.world, asked.planner) == (world, planner)


def test_a_run_goes_on_in_its_own_world(tmp_path: Path) -> None:
    """Two phases here and one there are the same as all three at once."""
    ours = replace(CONFIG, world=SimulatedConfig(friction={"joint": 2.0}))
    run(ours, tmp_path / "whole")
    first = replace(ours, phases=("model", "policy"))
    run(first, tmp_path / "part")
    assert run(first, tmp_path / "part", resume=True).finished
    later = replace(ours, phases=("evaluate",), start_from=str(tmp_path / "part"))
    run(later, tmp_path / "last")
    whole, last = (
        json.loads((tmp_path / name / "evaluation.json").read_text())["planner"]["returns"]
        for name in ("whole", "last")
    )
    assert whole == last
    with pytest.raises(ConfigError, match=r"world\.friction\.joint: None, not 2\.0"):
        run(replace(first, world=SimulatedConfig()), tmp_path / "part", resume=True)


def test_resume_names_the_directory(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^run_dir: expected none with resume"):
        request(f"resume={tmp_path}", "run_dir=elsewhere")
    with pytest.raises(ConfigError, match=r"no config\.yaml"):
        request(f"resume={tmp_path}")


@pytest.mark.parametrize(
    "text",
    ["- 1\n", "task: [\n", "3\n", "", "seed: 1\nseed: 2\n", "seed: !!python/name:os.system\n"],
)
def test_a_broken_configuration_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"config\.yaml: "):
        request(f"resume={tmp_path}")


def test_a_world_of_the_callers_is_used_and_named(tmp_path: Path) -> None:
    """``run`` takes a world in the place of the one that the settings describe."""
    world = SimulatedWorld(CONFIG.task, SimulatedConfig(friction={"joint": 2.0}))
    tiny = with_sections(replace(CONFIG, phases=("model",)))
    run(tiny, tmp_path / "given", world=world)
    run(replace(tiny, world=world.config), tmp_path / "described")
    states = [
        (tmp_path / name / "phases/model").rglob("tensors.safetensors")
        for name in ("given", "described")
    ]
    ours, theirs = (next(paths).read_bytes() for paths in states)
    assert ours == theirs


def test_a_file_is_read_as_omegaconf_reads_it() -> None:
    """Which wrote it."""
    for path in (COMMITTED[0], COMMITTED[len(COMMITTED) // 2], COMMITTED[-1]):
        expected = OmegaConf.to_container(OmegaConf.load(path / "config.yaml"))
        assert parse_yaml((path / "config.yaml").read_text(encoding="utf-8")) == expected


@pytest.mark.parametrize(
    "value",
    ["1e-3", "-1E5", "+.5e2", "1.5e+3", "1.5e3", "1_0.5", "12", "0x1f", "010", "1e", "e1", ".e1",
     ".5e3", "2026-01-31", "12:30", "yes", "off", "null", "~", ".inf", "-.inf", "'1e-3'", "${seed}",
     "???"],
)  # fmt: skip
def test_values_are_those_of_omegaconf(tmp_path: Path, value: str) -> None:
    text = f"seed: 1\nvalue: {value}\n"
    (tmp_path / "config.yaml").write_text(text)
    ours = parse_yaml(text)["value"]
    read: Any = OmegaConf.to_container(OmegaConf.load(tmp_path / "config.yaml"))
    theirs = read["value"]
    assert (type(ours), ours) == (type(theirs), theirs)


# Earlier versions


def test_every_committed_run_is_still_read() -> None:
    """Their files say nothing of worlds and of kinds of planners."""
    assert len(COMMITTED) > 100
    for path in COMMITTED:
        kept = RunDirectory(path).read_config()
        config = read_run_config(kept)
        assert config.world == SimulatedConfig(), path.name
        assert (config.task, config.seed) == (kept["task"], kept["seed"])
        method = METHODS[config.method]
        assert (config.planner is not None) == method.plans
        if method.plans:
            assert isinstance(config.planner, CEMConfig)
            for key, value in kept["planner"].items():
                assert getattr(config.planner, key) == value, f"{path.name}: planner.{key}"
        for name in method.phases:
            section = config.section(name)
            for key, value in kept[name].items():
                if not isinstance(value, (dict, list)):
                    assert getattr(section, key) == value, f"{path.name}: {name}.{key}"
        again = json.loads(json.dumps(config.to_mapping()))  # lists for tuples, as files have them
        assert read_run_config(again) == config


def test_an_older_run_is_not_given_what_has_become_the_default() -> None:
    """Before there were fits of critics, nobody wrote that there are none."""
    paper = next(path for path in COMMITTED if path.name.startswith("pendulum-swingup-paper"))
    assert " refit:" not in (paper / "config.yaml").read_text()
    config = read_run_config(RunDirectory(paper).read_config())
    assert (config.section("policy").refit.interval, config.section("policy").refit.start) == (0, 0)
    assert not config.section("model").fit.shuffle_actions


def test_what_every_committed_run_earned_is_still_read() -> None:
    for path in COMMITTED:
        result = read_result(path)
        assert result is not None
        config = RunDirectory(path).read_config()
        assert result.task == config["task"]
        assert result.label == METHODS[config.get("method", "phihp")].label
        earned = json.loads((path / "evaluation.json").read_text())
        for way, part in earned.items():
            assert getattr(result, way) == pytest.approx((part["return_mean"],))
    assert {RunDirectory(path).read_config()["task"] for path in COMMITTED} >= set(TARGETS)


def test_a_run_without_an_evaluation_earned_nothing_yet(tmp_path: Path) -> None:
    run(replace(CONFIG, phases=("model",)), tmp_path / "run")
    assert read_result(tmp_path / "run") is None


def test_where_there_is_no_run_nothing_was_earned(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="not the directory of a run"):
        read_result(tmp_path)


def test_what_was_earned_in_another_world_is_called_by_it(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("task: pendulum\nworld: {kind: gymnasium}\n")
    (tmp_path / "metadata.json").write_text('{"real_steps": 60}')
    (tmp_path / "evaluation.json").write_text('{"actor": {"return_mean": -200.0}}')
    result = read_result(tmp_path)
    assert result is not None
    assert (result.task, result.actor, result.label) == (
        "pendulum in gymnasium", (-200.0,), "PhIHP",
    )  # fmt: skip
