"""What every test shares: one thread, fixed seeds, and no CUDA tests where there is no CUDA."""

from __future__ import annotations

import random
import sys
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import settings
from matplotlib.figure import Figure

SEED = 0

# One intra-op thread: xdist already fills the cores, and sums keep their order.
torch.set_num_threads(1)

# Compiling and first calls are slow, so no deadline; the same examples on every run.
settings.register_profile("phihp", deadline=None, derandomize=True)
settings.load_profile("phihp")


@pytest.fixture(autouse=True)
def seed() -> int:
    """Seed Python, NumPy and torch before every test; request it to know the number.

    Runs flush denormals for the rest of the process, which would make numbers differ with the order
    of the tests.
    """
    torch.set_flush_denormal(False)
    random.seed(SEED)
    np.random.seed(SEED)
    torch.manual_seed(SEED)
    return SEED


@pytest.fixture
def drawn() -> None:
    """Request it to have figures drawn; half of the time of a small evaluation goes there."""


@pytest.fixture(autouse=True)
def _undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every episode's figure is an empty one, which is written all the same."""
    if "drawn" in request.fixturenames:
        return
    for name in ("phihp_torchrl.evaluation.show", "phihp_torchrl.trainers.rehearsal"):
        if (module := sys.modules.get(name)) is not None:
            monkeypatch.setattr(module, "episode_figure", lambda *_, **__: Figure(figsize=(1, 1)))


@pytest.fixture
def aot_eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile as always, but for machine code, which takes minutes to make.

    Graphs are traced whole and differentiated, and then run by torch.
    """
    compile = torch.compile

    def traced(function: Any, *, fullgraph: bool, dynamic: bool | None, **_: Any) -> Any:
        return compile(function, fullgraph=fullgraph, dynamic=dynamic, backend="aot_eager")

    monkeypatch.setattr(torch, "compile", traced)
    torch._dynamo.reset()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests marked ``cuda`` on a machine without it."""
    if torch.cuda.is_available():
        return
    skip = pytest.mark.skip(reason="needs a CUDA device")
    for item in items:
        if "cuda" in item.keywords:
            item.add_marker(skip)
