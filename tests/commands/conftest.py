"""Commands as from a console in an empty directory, whose registrations are forgotten."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from brief import shorten
from hydra.core.config_store import ConfigStore

import phihp_torchrl.tdmpc  # noqa: F401  (its phase stays registered)
from phihp_torchrl.commands import main
from phihp_torchrl.config import METHODS, choices
from phihp_torchrl.planners import PLANNERS
from phihp_torchrl.tasks import registry
from phihp_torchrl.trainers import PHASES
from phihp_torchrl.worlds import WORLDS

RECIPES = Path(__file__).parents[2] / "recipes"

Command = Callable[..., None]


@pytest.fixture(autouse=True)
def _brief_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten(monkeypatch)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory; what is imported from it is forgotten."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "modules", sys.modules)
    return tmp_path


@pytest.fixture
def registries(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """All registries, as they were again after the test."""
    for entries in (METHODS, PLANNERS, PHASES, WORLDS, registry._TASKS):
        monkeypatch.setattr(entries, "_entries", dict(entries._entries))
    monkeypatch.setattr(choices, "_OFFERED", dict(choices._OFFERED))
    store = ConfigStore.instance()
    monkeypatch.setattr(store, "repo", {**store.repo})
    before = {*sys.modules}
    yield
    for name in {*sys.modules} - before:
        if name.startswith("phihp_torchrl_plugin_"):
            del sys.modules[name]


@pytest.fixture
def phihp(place: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run ``phihp <words>`` in an empty directory."""

    def run(*words: str) -> None:
        monkeypatch.setattr(sys, "argv", ["phihp", *words])
        main(words)

    return run


@pytest.fixture
def recipe(place: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """Run ``python recipes/<name>.py <words>`` in an empty directory."""
    monkeypatch.syspath_prepend(str(RECIPES))

    def run(name: str, *words: str) -> None:
        path = str(RECIPES / f"{name}.py")
        monkeypatch.setattr(sys, "argv", [path, *words])
        runpy.run_path(path, run_name="__main__")

    return run
