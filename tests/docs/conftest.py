"""A place to run printed examples in, with small settings, and everything as it was afterwards."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import pytest
from brief import STEPS, shorten

import phihp_torchrl
import phihp_torchrl.tdmpc  # its phase and agent stay registered
from phihp_torchrl.commands import learn
from phihp_torchrl.config import Registry, override_lines
from phihp_torchrl.config.choices import _OFFERED
from phihp_torchrl.worlds.simulated.plant import _PLANTS
from tests.docs.blocks import ROOT, write_titled

TINY = {
    "model.real_steps": 50,
    "model.integrator": "semi_implicit_euler",  # the choice of one fits five, and has tests
    "model.fit.steps": 2,
    "model.collect.planning_horizon": 3,
    "model.collect.num_candidates": 8,
    "model.collect.top_k": 2,
    "model.collect.optim_steps": 1,
    "model.collect.replan_every": 2,
    "policy.updates": 2,
    "policy.batch_size": 8,
    "policy.num_worlds": 4,
    "policy.chunk_steps": 2,
    "policy.updates_per_step": 2,
    "policy.evaluation_interval": 2,
    "policy.evaluation_episodes": 2,
    "policy.evaluation_steps": 20,
    "policy.td3.actor_hidden_sizes": [8],
    "policy.td3.critic_hidden_sizes": [8],
    "policy.refit.interval": 0,
    "policy.random_steps": 64,
    "planner.num_candidates": 8,
    "planner.num_policy_candidates": 2,
    "planner.top_k": 2,
    "planner.planning_horizon": 2,
    "planner.num_kept_elites": 0,
    "calibrate.enabled": False,
    "evaluate.episodes": 1,
    "evaluate.latency_actions": 0,
    "evaluate.baselines": "none",
    "evaluate.video": False,
    "compile": False,
    "progress": False,
}
"""What makes a printed run short; it goes over what the example says."""


@contextmanager
def as_before(place: Path) -> Iterator[None]:
    """Afterwards nothing is registered or imported from ``place``, as after a process."""
    # Every registry, so that none is forgotten. `isinstance` would ask dead weak references.
    registries = [each for each in gc.get_objects() if issubclass(type(each), Registry)]
    tables = [_OFFERED, _PLANTS, *(each._entries for each in registries)]
    before = [dict(table) for table in tables]
    try:
        yield
    finally:
        for table, entries in zip(tables, before, strict=True):
            table.clear()
            table.update(entries)
        for name, module in list(sys.modules.items()):
            if str(getattr(module, "__file__", None) or "").startswith(str(place)):
                del sys.modules[name]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A working directory with every file that a page prints and with the trained agents."""
    write_titled(tmp_path)
    (tmp_path / "results").symlink_to(ROOT / "results")
    monkeypatch.chdir(tmp_path)
    for directory in {tmp_path, *(path.parent for path in tmp_path.glob("*/*.py"))}:
        monkeypatch.syspath_prepend(directory)
    with as_before(tmp_path):
        yield tmp_path


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs and episodes are short, and windows do not wait for the clock on the wall."""

    def learn_little(*arguments, overrides=(), **options):
        lines = [*override_lines(overrides), *override_lines(TINY)]
        with pytest.MonkeyPatch.context() as patch:
            shorten(patch)
            return learn(*arguments, overrides=lines, **options)

    def make_brief(*arguments, **options):
        return gymnasium.wrappers.TimeLimit(make(*arguments, **options), STEPS)

    make = gymnasium.make
    monkeypatch.setattr(gymnasium, "make", make_brief)
    monkeypatch.setattr(phihp_torchrl, "learn", learn_little, raising=False)
    pygame = pytest.importorskip("pygame")
    monkeypatch.setattr(pygame.time, "Clock", lambda: SimpleNamespace(tick=lambda rate: None))
