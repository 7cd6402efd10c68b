"""The methods: each runs, evaluates what it acts with, and goes on after a crash."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from phihp_torchrl.config import METHODS, get_method
from phihp_torchrl.deployment import load_agent
from phihp_torchrl.tasks import get_task, list_tasks, register_task
from phihp_torchrl.trainers import read_result, run
from phihp_torchrl.trainers.checkpoints import load_state
from phihp_torchrl.trainers.run_loop import RunLoop

from .method_parts import TASKS, small
from .run_parts import CONFIG, Crash, assert_equal, forget_settings, rows

PARTS = {
    "hybrid_planner": {"planner", "actor"},
    "plain_planner": {"planner"},
    "actor": {"actor"},
    "own_planner": {"planner", "actor"},
}
RESUMED = ("phihp", "td3", "td-mpc", "cem-oracle", "td-mpc-star")
"""Methods with every phase, every way to act and every kind of model among them."""


@pytest.fixture(scope="module")
def wholes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run of every method that nothing disturbed."""
    paths = {name: tmp_path_factory.mktemp("runs") / name for name in METHODS}
    for name, path in paths.items():
        assert run(small(name), path).finished
    return paths


@pytest.mark.parametrize("method", METHODS)
def test_a_run_evaluates_and_saves_what_the_method_acts_with(
    wholes: dict[str, Path], method: str
) -> None:
    path, chosen = wholes[method], get_method(method)
    results = json.loads((path / "evaluation.json").read_text())
    assert results.keys() == PARTS[chosen.acting]
    agent = load_agent(path / "agent")
    assert (agent.planner is not None) == ("planner" in PARTS[chosen.acting])
    assert (agent.actor is not None) == (chosen.acting != "plain_planner")
    steps = json.loads((path / "metadata.json").read_text())["real_steps"]
    assert agent.metadata["samples"] == steps
    sections = small(method).sections.values()
    assert steps == sum(getattr(section, "real_steps", 0) for section in sections)
    result = read_result(path)
    assert (result.label, result.samples) == (chosen.label, steps)


@pytest.mark.parametrize("method", RESUMED)
def test_a_run_that_crashed_goes_on_to_the_same_end(
    wholes: dict[str, Path], tmp_path: Path, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    units = len(rows(wholes[method]))
    log_unit = RunLoop._log_unit

    def crash(self: Any, *arguments: Any) -> None:
        log_unit(self, *arguments)
        if self.position.unit in (units // 2, units - 1) and self.position.unit not in crashed:
            crashed.add(self.position.unit)
            raise Crash

    crashed: set[int] = set()
    monkeypatch.setattr(RunLoop, "_log_unit", crash)
    with pytest.raises(Crash):
        run(small(method), tmp_path / "run")
    for _ in range(3):
        torch.rand(3)
        try:
            finished = run(small(method), tmp_path / "run", resume=True).finished
            break
        except Crash:
            continue
    assert finished
    assert rows(tmp_path / "run") == rows(wholes[method])
    for phase in small(method).phases_to_do:
        states = [
            load_state(path / "phases" / phase, metadata={"task": CONFIG.task})
            for path in (tmp_path / "run", wholes[method])
        ]
        assert_equal(*states, phase)


def test_what_is_resumed_has_all_that_a_method_may_have() -> None:
    assert set(RESUMED) <= set(METHODS)
    for parts in (lambda m: m.phases, lambda m: (m.acting,)):
        every, resumed = (
            {part for name in names for part in parts(METHODS[name])}
            for names in (METHODS, RESUMED)
        )
        assert resumed == every


def test_a_method_may_go_on_from_the_phases_of_another(
    wholes: dict[str, Path], tmp_path: Path
) -> None:
    """The actor of TD3-im-ph is that of PhIHP, so one training serves both."""
    later = replace(small("td3-im-ph"), phases=("evaluate",), start_from=str(wholes["phihp"]))
    assert run(later, tmp_path / "run").finished
    ours, theirs = (
        json.loads((path / "evaluation.json").read_text())["actor"]["returns"]
        for path in (tmp_path / "run", wholes["phihp"])
    )
    assert ours == theirs
    assert json.loads((tmp_path / "run" / "metadata.json").read_text())["real_steps"] == 60


@pytest.mark.parametrize(
    ("method", "name"),
    [(("phihp", "td-mpc-star", "td3")[i % 3], name) for i, name in enumerate(TASKS)],
)
def test_every_task_starts_and_steps(tmp_path: Path, method: str, name: str) -> None:
    """No method looks at which task it has: each has run above, so that here each task runs."""
    brief = f"brief-{name}"
    if brief not in list_tasks():
        register_task(replace(get_task(name), name=brief, max_steps=20))
    result = run(small(method, brief), tmp_path / name)
    assert result.finished
    with (tmp_path / name / "metrics.csv").open(newline="") as file:
        phases = [row["phase"] for row in csv.DictReader(file)]
    assert phases[-1] == "evaluate"
    for part in PARTS[get_method(method).acting]:
        assert abs(result.metrics[f"evaluate/{part}/return_mean"]) < 500


# Older runs


def test_a_run_from_before_there_were_methods_is_phihps(
    wholes: dict[str, Path], tmp_path: Path
) -> None:
    older = tmp_path / "older"
    run(replace(CONFIG, phases=("model",)), older)
    content = OmegaConf.load(older / "config.yaml")
    content.pop("method")
    OmegaConf.save(content, older / "config.yaml")
    forget_settings(older)
    assert run(replace(CONFIG, phases=("model",)), older, resume=True).finished
    later = replace(CONFIG, phases=("policy",), start_from=str(older))
    assert run(later, tmp_path / "later").finished
