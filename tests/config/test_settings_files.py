"""The YAML files: every key explained, and nothing in them that the dataclasses do not say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from bare_keys import bare_keys
from omegaconf import OmegaConf

from phihp_torchrl.commands.mirror import mirror
from phihp_torchrl.config import YAML, flatten, kind_mapping, sentences, to_mapping
from phihp_torchrl.planners import PLANNERS
from phihp_torchrl.trainers import PHASES, LoggerConfig, RunConfig
from phihp_torchrl.worlds import WORLDS

FILES = sorted(YAML.rglob("*.yaml"))
PLACES = {"run_dir": None, "resume": None, "trust": False}
"""Settings that say where a run is, and are no part of it."""


def read(name: str) -> dict[str, Any]:
    plain: Any = OmegaConf.to_container(OmegaConf.load(YAML / name))
    return plain


def name_of(path: Path) -> str:
    return str(path.relative_to(YAML).with_suffix(""))


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_every_key_has_a_comment_above_it(path: Path) -> None:
    assert not bare_keys(path)


@pytest.mark.parametrize("name", [str(name) for name in mirror()])
def test_the_mirror_has_nothing_to_write(name: str) -> None:
    assert (YAML / name).read_text() == mirror()[Path(name)]


def test_the_defaults_are_those_of_the_dataclasses() -> None:
    ours = read("defaults.yaml")
    for name, kind in PHASES.items():
        assert ours.pop(name) == to_mapping(kind.config()), name
    run = RunConfig(task="pendulum").to_mapping()
    groups = ("task", "method", "preset", "world", "planner", "logger")
    rest = {key: value for key, value in run.items() if key not in (*groups, *PHASES)}
    assert ours == {**rest, "phases": None, **PLACES}


@pytest.mark.parametrize(
    ("group", "kinds"), [("world", WORLDS), ("planner", PLANNERS)], ids=["world", "planner"]
)
def test_kinds_of_worlds_and_planners_are_those_of_the_dataclasses(group: str, kinds: Any) -> None:
    files = {path.stem for path in (YAML / group).glob("*.yaml")}
    assert files == set(kinds)
    for name, kind in kinds.items():
        given = read(f"{group}/{name}.yaml")
        missing = {key: key for key, value in given.items() if value == "???"}
        if "make" in missing:
            missing["make"] = "module:function"
        assert {**given, **missing} == kind_mapping(kind.config(**missing))


@pytest.mark.parametrize("name", ["csv", "tensorboard", "wandb"])
def test_loggers_are_those_of_the_dataclass(name: str) -> None:
    assert read(f"logger/{name}.yaml") == to_mapping(LoggerConfig(name=name))


# Layers


def layer(name: str) -> dict[str, Any]:
    """What a file changes, by dotted key."""
    content = read(name)
    sections = content.pop("presets", {})
    for preset, section in sections.items():
        if preset == Path(name).stem:
            content |= section
    return flatten(content)


def defaults() -> dict[str, Any]:
    planner = {f"planner.{key}": value for key, value in read("planner/cem.yaml").items()}
    return {**flatten(read("defaults.yaml")), **planner, "preset": None}


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_preset_holds_differences_alone(preset: str) -> None:
    changes, base = layer(f"preset/{preset}.yaml"), defaults()
    assert changes.keys() <= base.keys()
    same = [key for key, value in changes.items() if base[key] == value]
    assert not same
    assert changes["preset"] == preset


def test_the_default_preset_is_the_dataclasses_but_for_the_search() -> None:
    changes = layer("preset/default.yaml")
    assert changes.pop("preset") == "default"
    assert {key.split(".")[0] for key in changes} == {"planner"}


@pytest.mark.parametrize("path", sorted((YAML / "task").glob("*.yaml")), ids=lambda p: p.stem)
def test_a_task_changes_what_there_is(path: Path) -> None:
    content = read(f"task/{path.name}")
    assert content.pop("task") == path.stem
    presets = content.pop("presets")
    assert not content
    assert presets.keys() <= {"default", "paper"}
    known = defaults().keys()
    for preset, section in presets.items():
        assert flatten(section).keys() <= known, preset


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_help_finds_a_sentence_for_every_key(path: Path) -> None:
    text = path.read_text()
    if path.stem == "train":  # a list of defaults, which are no settings of their own
        assert {"task", "world", "method"} <= {key.split(".")[-1] for key in sentences(text)}
        return
    assert flatten(read(str(path.relative_to(YAML)))).keys() <= sentences(text).keys()
