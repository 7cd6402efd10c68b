"""What tests of runs share: one that nothing disturbed, and the smallest method."""

from __future__ import annotations

from pathlib import Path

import pytest

from phihp_torchrl.config import METHODS, choices
from phihp_torchrl.trainers import PHASES, calibrate, run

from .run_parts import CONFIG
from .tally import register_tally


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nothing disturbed."""
    path = tmp_path_factory.mktemp("runs") / "whole"
    assert run(CONFIG, path).finished
    return path


@pytest.fixture
def tally(monkeypatch: pytest.MonkeyPatch) -> None:
    """The smallest method is registered, for one test."""
    for registry in (METHODS, PHASES):
        monkeypatch.setattr(registry, "_entries", dict(registry._entries))
    monkeypatch.setattr(choices, "_OFFERED", dict(choices._OFFERED))
    register_tally()


@pytest.fixture
def restless(monkeypatch: pytest.MonkeyPatch) -> None:
    """No actor is taken to rest."""
    monkeypatch.setattr(calibrate, "RESTS", -1.0)
