"""The examples in the package's docstrings, a test for each module that has some."""

from __future__ import annotations

import doctest
import importlib
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import pytest

import phihp_torchrl.tdmpc  # noqa: F401  (its phase and agent stay registered)
from phihp_torchrl.config import METHODS
from phihp_torchrl.config.choices import _OFFERED
from phihp_torchrl.deployment import AGENT_KINDS
from phihp_torchrl.dynamics import PRIORS
from phihp_torchrl.integrators import INTEGRATORS
from phihp_torchrl.planners import PLANNERS
from phihp_torchrl.tasks.registry import _TASKS
from phihp_torchrl.trainers import LEARNERS, PHASES
from phihp_torchrl.worlds import WORLDS
from phihp_torchrl.worlds.simulated.plant import _PLANTS

REGISTRIES = (METHODS, AGENT_KINDS, PRIORS, INTEGRATORS, PLANNERS, _TASKS, PHASES, LEARNERS, WORLDS)
ROOT = Path(__file__).parents[1]


def modules() -> list[str]:
    paths = sorted((ROOT / "phihp_torchrl").rglob("*.py"))
    with_examples = [path for path in paths if ">>> " in path.read_text()]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in with_examples]
    names = [name.removesuffix(".__init__") for name in names]
    # ConfigError says that it lives in the folder, so doctest finds its example only there.
    return ["phihp_torchrl.config" if name.endswith(".config.errors") else name for name in names]


@pytest.fixture
def kept_registries() -> Iterator[None]:
    """Forget what examples register, which other tests of this process would meet."""
    entries = [registry._entries for registry in REGISTRIES]
    kept = [(each, dict(each)) for each in (*entries, _OFFERED, _PLANTS, gymnasium.registry)]
    yield
    for each, before in kept:
        each.clear()
        each.update(before)


@pytest.mark.parametrize("module", modules())
@pytest.mark.usefixtures("kept_registries")
def test_examples(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    imported = importlib.import_module(module)
    monkeypatch.chdir(tmp_path)  # examples leave no files behind
    failed, tried = doctest.testmod(imported, optionflags=doctest.NORMALIZE_WHITESPACE)
    assert (failed, tried > 0) == (0, True)
