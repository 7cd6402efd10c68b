"""What commands print before any work: help, settings, lists, and errors in one sentence."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import yaml

from phihp_torchrl.config import METHODS, YAML, load_config
from phihp_torchrl.planners import PLANNERS
from phihp_torchrl.tasks import list_tasks
from phihp_torchrl.trainers import read_run_config
from phihp_torchrl.worlds import WORLDS

from .command_parts import PLUGIN
from .conftest import Command

TEN = [
    "task", "world", "method", "preset", "budget", "seed", "model.real_steps", "policy.updates",
    "evaluate.episodes", "logger",
]  # fmt: skip


def shown(text: str) -> dict[str, str]:
    """The settings that a help text shows, with their values."""
    lines = [line.split()[0] for line in text.splitlines() if line.startswith("  ") and "=" in line]
    return dict(line.split("=", 1) for line in lines if "=" in line)


def out(capsys: pytest.CaptureFixture[str]) -> str:
    return capsys.readouterr().out


def test_the_commands_are_listed(phihp: Command, capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--help"], ["-h"]):
        phihp(*words)
        text = out(capsys)
        assert text.startswith("usage: phihp COMMAND")
        for command in ("train", "evaluate", "identify", "export", "list"):
            assert f"\n  {command} " in text


@pytest.mark.parametrize(
    ("words", "values"),
    [
        (["task=acrobot"], {"task": "acrobot", "model.real_steps": "2500", "budget": "full"}),
        (["task=acrobot", "preset=paper"], {"model.real_steps": "5000", "preset": "paper"}),
        (["task=pendulum", "budget=fast"], {"model.real_steps": "1000", "budget": "fast"}),
        (["method=cem-oracle", "seed=3"], {"model.real_steps": "0", "seed": "3"}),
        (["policy.updates=7", "logger=wandb"], {"policy.updates": "7", "logger": "wandb"}),
        (
            ["world=gymnasium", "world.id=Pendulum-v1"],
            {"task": "pendulum", "world": "gymnasium", "model.real_steps": "1000"},
        ),
    ],
)
def test_ten_settings_as_they_are_for_the_task(
    phihp: Command, capsys: pytest.CaptureFixture[str], words: Sequence[str], values: dict[str, str]
) -> None:
    phihp("train", *words, "--help")
    text = out(capsys)
    assert list(shown(text)) == TEN
    assert shown(text).items() >= values.items()
    for line in text.splitlines():
        assert len(line) <= 100
        if line.startswith("  ") and "=" in line.split()[0]:
            assert len(line.split()) > 1, "each with a sentence"


def test_a_recipe_shows_its_own_method(recipe: Command, capsys: pytest.CaptureFixture[str]) -> None:
    for name, method in (("cem", "cem-oracle"), ("td3", "td3"), ("tdmpc", "td-mpc")):
        recipe(name, "--help")
        assert shown(out(capsys))["method"] == method


def test_every_setting_has_a_sentence_and_can_be_read_back(
    phihp: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["task=acrobot", "preset=paper", "world.substeps=2", "planner.alpha=0.5"]
    phihp("train", *words, "--cfg", "job")
    text = out(capsys)
    read = yaml.safe_load(text)
    assert read == load_config(overrides=words)
    assert read_run_config(read).planner.alpha == 0.5
    above = ""
    for line in text.splitlines():
        key = line.strip()
        if ":" in key and not key.startswith(("#", "-")) and not key.endswith(":"):
            assert above.strip().startswith("#"), line
        above = line


@pytest.mark.usefixtures("registries")
def test_a_plugins_settings_are_shown_too(
    phihp: Command, place: object, capsys: pytest.CaptureFixture[str], tmp_path: object
) -> None:
    (place / "my_plugin.py").write_text(PLUGIN)  # type: ignore[operator]
    words = ["plugins=[my_plugin.py]", "task=my-pendulum", "method=rested", "world=rig"]
    phihp("train", *words, "--cfg", "job")
    read = yaml.safe_load(out(capsys))
    assert (read["rest"], read["world"]) == ({"naps": 1}, {"kind": "rig", "number": 1})
    phihp("train", *words, "--help")
    assert shown(out(capsys))["task"] == "my-pendulum"
    phihp("list", "plugins=[my_plugin.py]")
    text = out(capsys)
    for name in ("my-pendulum", "rested", "rig", "patient"):
        assert f"\n  {name} " in text


def test_the_list_has_all_there_is(phihp: Command, capsys: pytest.CaptureFixture[str]) -> None:
    phihp("list")
    text = out(capsys)
    presets = [path.stem for path in (YAML / "preset").glob("*.yaml")]
    for name in (*list_tasks(), *METHODS, *presets, *WORLDS, *PLANNERS):
        lines = [line for line in text.splitlines() if line.split()[:1] == [name]]
        assert lines, name
        assert all(len(line.split()) > 1 for line in lines), "each with a word on what it is"


@pytest.mark.parametrize(
    ("command", "setting"),
    [
        ("evaluate", "latency_actions"),
        ("identify", "steps"),
        ("export", "tolerance"),
        ("list", "plugins"),
    ],
)
def test_the_other_commands_explain_their_settings(
    phihp: Command, capsys: pytest.CaptureFixture[str], command: str, setting: str
) -> None:
    phihp(command, "--help")
    text = out(capsys)
    assert text.startswith(f"usage: phihp {command} ")
    rows = [line for line in text.splitlines() if line.startswith("  ")]
    assert [line for line in rows if line.split("=")[0].strip() == setting]
    assert all(len(line.split()) > 1 for line in rows)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["tain"], r"^error: command: expected one of .*'tain'"),
        (["train", "--help", "task=nothing"], "^error: task: expected one of .*'nothing'"),
        (["train", "--cfg", "job", "policy.updatez=1"], r"^error: policy\.updatez: unknown key"),
        (["list", "plugin=[a.py]"], "^error: plugin: unknown key; did you mean 'plugins'"),
        (["evaluate", "planner=maybe", "agent=x"], "^error: planner: expected one of"),
    ],
)
def test_a_wrong_word_is_one_sentence(phihp: Command, words: list[str], message: str) -> None:
    with pytest.raises(SystemExit, match=message):
        phihp(*words)
