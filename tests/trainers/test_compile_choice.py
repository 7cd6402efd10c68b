"""``compile: auto``: what earns its compilation, said once and kept by the run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from phihp_torchrl import HybridDynamics, load_config, make_world
from phihp_torchrl.config import ConfigError
from phihp_torchrl.trainers import compile_choice, read_run_config, run
from phihp_torchrl.trainers.compile_choice import Earned, earned, earned_by_step
from phihp_torchrl.worlds import EnvWorld

from .run_parts import CONFIG

WORLD = make_world("pendulum-swingup")
AUTO = replace(CONFIG, compile="auto", progress=True)


def found(name, *words, preset="default", world=WORLD, **changes):
    config = read_run_config(load_config("pendulum-swingup", preset=preset, overrides=list(words)))
    return earned(config, name, replace(config.section(name), **changes), world)


def test_more_work_earns_what_less_does_not():
    assert not found("policy").pays
    assert found("policy", updates=10_000_000).pays
    assert found("policy", preset="paper").pays


@pytest.mark.parametrize(
    "changes",
    [{"updates": 24_000}, {"evaluation_interval": 50}, {"patience": 0.0}, {"updates_per_step": 4}],
    ids=str,
)
def test_whatever_takes_longer_saves_more(changes):
    longer, usual = found("policy", **{"patience": 0.5, **changes}), found("policy", patience=0.5)
    assert longer.saved > usual.saved
    assert longer.taken == usual.taken


def test_a_world_without_truth_is_not_counted_twice():
    assert found("policy", real_evaluation_episodes=0).taken < found("policy").taken


@pytest.mark.parametrize("name", ["model", "dream"])
def test_a_phase_that_compiles_nothing_or_is_unknown_earns_nothing(name):
    config = read_run_config(load_config("pendulum"))
    assert earned(config, name, None, WORLD) == Earned(0.0, 0.0)
    assert not Earned(0.0, 0.0).pays


def test_episodes_of_a_batch_are_no_reason_to_compile_plans():
    assert found("evaluate") == Earned(0.0, 0.0)
    alone = EnvWorld(WORLD.task, WORLD.make_env)
    assert found("evaluate", world=alone).pays
    several = EnvWorld(WORLD.task, WORLD.make_env, copies=True)
    assert found("evaluate", world=several) == Earned(0.0, 0.0)
    assert not found("evaluate", world=alone, episodes=1, latency_actions=0).pays


PHASES = ("policy", "calibrate", "evaluate")


def by_step(operations, phases=PHASES, world=WORLD, *words):
    config = read_run_config(load_config("pendulum-swingup", overrides=list(words)))
    return earned_by_step(config, phases, world, operations)


def test_a_step_of_few_operations_earns_no_graph_and_one_of_many_does():
    assert by_step(40).saved == 0.0
    assert not by_step(40).pays
    assert by_step(2000).pays
    assert by_step(2000).taken > by_step(1000).taken


@pytest.mark.parametrize("name", PHASES)
def test_every_phase_that_imagines_counts(name):
    assert 0.0 < by_step(1000, (name,)).saved < by_step(1000).saved


def test_a_step_that_nobody_calls_takes_nothing():
    assert by_step(1000, ("model",)) == by_step(1000, ()) == Earned(0.0, 0.0)


def test_a_phase_with_graphs_of_its_own_calls_no_step():
    config = read_run_config(load_config("pendulum-swingup", preset="paper"))
    assert earned(config, "policy", config.section("policy"), WORLD).pays
    assert earned_by_step(config, ("policy",), WORLD, 1000) == Earned(0.0, 0.0)


def test_plans_that_call_a_compiled_step_have_no_graph_of_their_own():
    alone = EnvWorld(WORLD.task, WORLD.make_env)
    several = EnvWorld(WORLD.task, WORLD.make_env, copies=True)
    config = read_run_config(load_config("pendulum-swingup"))
    section = config.section("evaluate")
    assert earned(config, "evaluate", section, alone).pays
    assert earned(config, "evaluate", section, alone, step=True) == Earned(0.0, 0.0)
    assert by_step(600, ("evaluate",), alone).saved > by_step(600, ("evaluate",)).saved > 0.0
    assert by_step(600, ("evaluate",), several) == by_step(600, ("evaluate",))


def test_a_run_compiles_the_step_that_it_has_chosen(tmp_path: Path, capfd, monkeypatch) -> None:
    cheap = {"operations": 1, "seconds": 1e-9, "eager": 1.0, "compiled": 0.0}
    monkeypatch.setattr(compile_choice, "_ALONE", cheap)
    compiled = []
    monkeypatch.setattr(HybridDynamics, "compile_step", lambda self: compiled.append(self))
    made = run(AUTO, tmp_path / "run")
    assert "a step of the model is compiled: " in capfd.readouterr().err
    assert json.loads((made.path / "metadata.json").read_text())["compiled"]["step"]
    assert len(compiled) == 2  # for both phases after the model's
    run(replace(CONFIG, compile=False), tmp_path / "without")
    assert len(compiled) == 2


@pytest.mark.parametrize(("method", "phase"), [("td3", "td3"), ("td-mpc", "tdmpc")])
def test_model_free_methods_have_a_choice_too(method, phase):
    config = read_run_config(load_config("pendulum", method=method, preset="paper"))
    of = earned(config, phase, config.section(phase), WORLD)
    assert of.saved > 0.0
    assert of.taken > 0.0


def test_what_compile_may_be():
    with pytest.raises(ConfigError, match="compile"):
        replace(CONFIG, compile="perhaps")


def test_a_run_says_and_keeps_its_choice(tmp_path: Path, capfd, monkeypatch) -> None:
    whole = run(AUTO, tmp_path / "whole")
    said = capfd.readouterr().err
    assert said.count("policy runs uncompiled: compiling would take about ") == 1
    kept = json.loads((whole.path / "metadata.json").read_text())["compiled"]
    assert kept == {"model": False, "policy": False, "step": False, "evaluate": False}
    # Other rates, of a later version, do not change what a begun run has chosen.
    monkeypatch.setattr(compile_choice, "_PHASES", {"policy": lambda *_: Earned(9.0, 1.0)})
    torch._dynamo.utils.counters.clear()
    for name in ("policy", "evaluate"):
        (whole.path / "phases" / name).rename(tmp_path / name)
    assert run(AUTO, whole.path, resume=True).finished
    assert "policy is compiled" not in capfd.readouterr().err
    assert not torch._dynamo.utils.counters["stats"]["unique_graphs"]
