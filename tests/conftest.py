"""What every test shares: one thread, fixed seeds, and no CUDA tests where there is no CUDA."""

from __future__ import annotations

import pickle
import random
import sys
from collections.abc import Iterator
from io import StringIO, TextIOBase
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from forked import Forks
from hypothesis import settings
from matplotlib.figure import Figure
from omegaconf import OmegaConf

SEED = 0

# One intra-op thread: xdist already fills the cores, and sums keep their order.
torch.set_num_threads(1)

# Compiling and first calls are slow, so no deadline; the same examples on every run.
settings.register_profile("phihp", deadline=None, derandomize=True, max_examples=50)
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


@pytest.fixture(scope="session", autouse=True)
def _undrawn() -> Iterator[None]:
    """Every episode's figure is an empty one, which is written all the same.

    Half of the time of a small run would go there. For the whole session, so that runs which many
    tests share are made so too, and no test that undoes its own patches undoes this one.
    """
    with pytest.MonkeyPatch.context() as patch:
        for module in _drawing():
            patch.setattr(module, "episode_figure", lambda *_, **__: Figure(figsize=(1, 1)))
        yield


@pytest.fixture(scope="session", autouse=True)
def _parsed_once() -> Iterator[None]:
    """A YAML file is parsed once, not by each of the hundreds of compositions.

    Every reader gets an object of its own.
    """
    parsed: dict[str, bytes] = {}
    load = OmegaConf.load

    def load_again(file: Any) -> Any:
        if not isinstance(file, TextIOBase):
            return load(file)
        text = file.read()
        if text not in parsed:
            parsed[text] = pickle.dumps(load(StringIO(text)))
        return pickle.loads(parsed[text])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", load_again)
        yield


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    """Starts processes, for which the package is imported once."""
    found = Forks()
    yield found
    found.close()


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Request it to have figures drawn."""
    for module in _drawing():
        drawing = sys.modules["phihp_torchrl.evaluation.figures"].episode_figure
        monkeypatch.setattr(module, "episode_figure", drawing)


def _drawing() -> list[ModuleType]:
    """The modules that draw, as far as they are loaded."""
    names = ("phihp_torchrl.evaluation.show", "phihp_torchrl.trainers.rehearsal")
    return [sys.modules[name] for name in names if name in sys.modules]


@pytest.fixture
def aot_eager(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile as always, but for machine code, which takes minutes to make.

    Graphs are traced whole and differentiated, and then run by torch.
    """
    _compile_by("aot_eager", monkeypatch)


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compile as always, but only as far as graphs: traced whole, and then run by torch."""
    _compile_by("eager", monkeypatch)


def _compile_by(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    compile = torch.compile

    def compiled(function: Any, *, fullgraph: bool, dynamic: bool | None, **_: Any) -> Any:
        return compile(function, fullgraph=fullgraph, dynamic=dynamic, backend=backend)

    monkeypatch.setattr(torch, "compile", compiled)
    torch._dynamo.reset()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests marked ``cuda`` on a machine without it."""
    if torch.cuda.is_available():
        return
    skip = pytest.mark.skip(reason="needs a CUDA device")
    for item in items:
        if "cuda" in item.keywords:
            item.add_marker(skip)
