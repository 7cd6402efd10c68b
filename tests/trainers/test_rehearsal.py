"""What a run writes at its end is tried before its first real step."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from phihp_torchrl import ConfigError
from phihp_torchrl.config import parse_overrides
from phihp_torchrl.trainers import rehearsal, resume_command, run
from phihp_torchrl.trainers.rehearsal import rehearse
from phihp_torchrl.worlds import SimulatedWorld, make_world

from .method_parts import small
from .run_parts import CONFIG, run_module

WORLD = make_world(CONFIG.task)


def fail(*_: object, **__: object) -> None:
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "save_agent",
            r"task: before any real step an .* was to be saved, .*No space",
        ),
        ("load_agent", r"task: before any real step an untrained agent was to be loaded"),
        ("make_dynamics", r"settings: before any real step an untrained agent was to be made"),
        ("episode_figure", r"task: before any real step an untrained agent was to be shown"),
    ],
)
def test_an_output_that_fails_ends_the_run_before_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, message: str
) -> None:
    monkeypatch.setattr(rehearsal, name, fail)
    monkeypatch.setattr(SimulatedWorld, "make_env", fail)  # no real step is taken
    with pytest.raises(ConfigError, match=f"^{message}"):
        run(CONFIG, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("method", ["phihp", "ph-cem", "cem-oracle", "td3", "td-mpc"])
def test_it_passes_for_every_kind_of_method_and_draws_no_number(method: str) -> None:
    config = small(method, CONFIG.task)
    torch.manual_seed(3)
    before = torch.get_rng_state()
    rehearse(config, WORLD)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.usefixtures("drawn")
def test_the_figure_that_is_tried_is_the_one_of_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    saved: list[Figure] = []
    save = Figure.savefig

    def savefig(self: Figure, *arguments: Any, **options: Any) -> None:
        save(self, *arguments, **options)
        saved.append(self)

    monkeypatch.setattr(Figure, "savefig", savefig)
    rehearse(CONFIG, WORLD)
    assert [bool(figure.axes) for figure in saved] == [True]


def test_a_planner_that_needs_too_much_memory_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def greedy(*_: object, **__: object) -> None:
        raise RuntimeError("not enough memory")

    monkeypatch.setattr(rehearsal.Agent, "forward", greedy)
    with pytest.raises(ConfigError, match=r"^planner: .* asked for an action, .*not enough memory"):
        rehearse(CONFIG, WORLD)


def test_a_run_without_an_evaluation_writes_no_agent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rehearsal, "save_agent", fail)
    rehearse(replace(CONFIG, phases=("model",)), WORLD)


# How to go on


PATHS = st.text(
    st.characters(blacklist_categories=("Cs", "Cc"), blacklist_characters="\0"), min_size=1
)


@given(PATHS | st.sampled_from(["a b", "a=b", "a,b", "é/ü", "it's", 'a"b', "$x", "[1]", "null"]))
def test_the_command_to_go_on_is_read_back_by_a_shell_and_by_hydra(path: str) -> None:
    *_, train, word = shlex.split(resume_command(path))
    (line,) = parse_overrides([word])
    assert (train, line.key_or_group, line.value()) == ("train", "resume", path)


def test_a_directory_that_holds_a_run_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "my run, größer=1"
    place.mkdir()
    (place / "config.yaml").write_text("task: pendulum")
    monkeypatch.setattr(run_module, "rehearse", lambda *_: None)
    with pytest.raises(ConfigError) as error:
        run(CONFIG, place)
    assert error.value.reason.endswith(f"go on with: {resume_command(place)}")
