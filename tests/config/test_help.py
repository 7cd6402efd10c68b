"""What ``--help`` prints: ten settings, their effective values, and all of it without torch."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
from omegaconf import OmegaConf

from phihp_torchrl import load_config
from phihp_torchrl.config import (
    YAML,
    ConfigError,
    flatten,
    help_text,
    sentences,
    settings_text,
)
from phihp_torchrl.config.help import FIRST


def shown(text: str) -> dict[str, str]:
    """The settings of a help text and their values."""
    return dict(re.findall(r"^  ([\w.]+)=(\S+) ", text, re.MULTILINE))


def test_help_shows_ten_settings_with_a_sentence_each() -> None:
    text = help_text([])
    assert len(FIRST) == 10
    assert list(shown(text)) == list(FIRST)
    assert len(re.findall(r"^  [\w.]+=\S+ +\w.*$", text, re.MULTILINE)) == 10
    assert max(map(len, text.splitlines())) <= 100
    assert "phihp list" in text
    assert "resume=DIR" in text


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], {"task": "pendulum-swingup", "method": "phihp", "world": "simulated"}),
        (["task=acrobot", "preset=paper"], {"task": "acrobot", "policy.updates": "500000"}),
        (["seed=3", "policy.updates=7"], {"seed": "3", "policy.updates": "7"}),
        (["budget=fast", "logger=wandb"], {"budget": "fast", "logger": "wandb"}),
        (["world=gymnasium", "world.id=Pendulum-v1"], {"world": "gymnasium"}),
    ],
)
def test_help_shows_the_values_that_count(words: list[str], expected: dict[str, str]) -> None:
    assert expected.items() <= shown(help_text(words)).items()


def test_help_shows_only_what_the_words_can_mean() -> None:
    with pytest.raises(ConfigError, match=r"^task: expected one of .*got 'unicycle'"):
        help_text(["task=unicycle"])


@pytest.mark.parametrize(
    "words", [[], ["planner=mppi"], ["task=acrobot", "preset=paper"]], ids=" ".join
)
def test_all_settings_are_shown_with_their_sentences(words: list[str]) -> None:
    text = settings_text(words)
    expected = load_config(overrides=words)
    told = sentences(text)
    assert flatten(expected).keys() <= told.keys()
    assert not [key for key, sentence in told.items() if "do not edit" in sentence]
    assert OmegaConf.to_container(OmegaConf.create(text)) == expected


def test_sentences_are_by_dotted_key() -> None:
    text = (
        "# of the file\n\n# top\na:\n  # inner one\n  # and two\n  b: 1\n  c: 2\nd: 3\n"
        "defaults:\n  # which\n  - override world: simulated\n"
    )
    assert sentences(text) == {"a": "top", "a.b": "inner one and two", "world": "which"}
    assert (
        sentences((YAML / "defaults.yaml").read_text())["policy.td3.gamma"]
        == 'discount γ, or its time constant, such as "5 s"'
    )


RUN = """
import sys
from phihp_torchrl.commands import main

for lines in sys.argv[1:]:
    exec(lines)
    heavy = sorted({"torch", "torchrl", "tensordict", "wandb", "matplotlib"} & set(sys.modules))
    print("imported", heavy, end="\\f")
"""


def heavy_after(*lines: str) -> list[tuple[str, list[str]]]:
    """What a new process prints after each line, and which large packages it has imported."""
    done = subprocess.run([sys.executable, "-c", RUN, *lines], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    parts = [part.rpartition("imported ") for part in done.stdout.split("\f")[:-1]]
    return [(printed, re.findall(r"'(\w+)'", heavy)) for printed, _, heavy in parts]


LIGHT = {
    "main(['--help'])": "usage: phihp COMMAND",
    "main(['train', '--help'])": "task=pendulum-swingup",
    "main(['train', '-h', 'task=acrobot'])": "task=acrobot",
    "main(['train', 'task=acrobot', '--cfg', 'job'])": "evaluation_interval",
    "import phihp_torchrl as p; print(p.load_config('acrobot')['task'])": "acrobot",
    "import gymnasium; print('phihp/Acrobot-v0' in gymnasium.registry)": "True",
}
"""What needs none of the large packages, and what it prints."""


def test_help_needs_no_torch() -> None:
    """The last line shows that the check sees what is imported, by the lightest of them."""
    *found, last = heavy_after(*LIGHT, "import matplotlib")
    for (printed, heavy), (line, expected) in zip(found, LIGHT.items(), strict=True):
        assert expected in printed, line
        assert not heavy, line
    assert last[1] == ["matplotlib"]
