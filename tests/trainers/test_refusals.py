"""What does not fit a method, or the task that it is to learn, is refused by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from phihp_torchrl.config import METHODS, ConfigError, Method, compose_yaml, register_method
from phihp_torchrl.systems import Pendulum, System
from phihp_torchrl.tasks import get_task, register_task, registry
from phihp_torchrl.trainers import read_request, run
from phihp_torchrl.worlds import Plant, register_plant

from .method_parts import small
from .run_parts import CONFIG


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+method=phip"], r"method: expected one of .*; did you mean 'phihp'\?"),
        (["method=ph-cem", "policy.updates=3"], r"policy\.updates: method 'ph-cem' has no use"),
        (["method=td3-im-ph", "planner.top_k=3"], r"planner\.top_k: method 'td3-im-ph' has no use"),
        (["method=ph-cem", "phases=[policy]"], r"phases: expected .*\['model', 'evaluate'\]"),
        (["method=dd-cem", "model.kind=hybrid"], r"model\.kind: expected 'data_driven'"),
        (
            ["method=ph-cem", "planner.num_policy_candidates=3"],
            r"num_policy_candidates: expected 0",
        ),
        (
            ["method=cem-oracle", "model.real_steps=-1"],
            r"real_steps: expected a whole number >= 0",
        ),
        (["method=ph-cem", "model.real_steps=0"], r"real_steps: expected a whole number >= 1"),
    ],
)
def test_what_does_not_fit_the_method_is_named(overrides: list[str], message: str) -> None:
    composed = compose_yaml([o for o in overrides if o.startswith("method=")])
    with pytest.raises(ConfigError, match=message):
        read_request(composed, [o.removeprefix("+") for o in overrides])


class Spring(Pendulum):
    """A pendulum whose equations are not to be known."""

    prior = System.prior


class SpringPlant(Plant):
    """What a spring really does."""

    def derivative(self, state, action):
        return torch.stack([state[..., 1], action[..., 0] - state[..., 0]], -1)


register_plant(Spring, SpringPlant)


@pytest.fixture
def spring(monkeypatch: pytest.MonkeyPatch) -> None:
    """A registered task without a prior, for one test."""
    monkeypatch.setattr(registry._TASKS, "_entries", dict(registry._TASKS._entries))
    register_task(replace(get_task("pendulum"), name="spring", system=Spring(), max_steps=20))


@pytest.mark.usefixtures("spring")
@pytest.mark.parametrize("method", METHODS)
def test_a_method_that_needs_a_prior_refuses_a_task_without_one(
    tmp_path: Path, method: str
) -> None:
    ours = small(method, "spring")
    if getattr(ours.sections.get("model"), "kind", None) == "hybrid":
        with pytest.raises(ConfigError, match=r"model\.kind: .*needs a prior, .*'spring', Spring"):
            run(ours, tmp_path / "run")
        assert not (tmp_path / "run").exists()
    else:
        assert run(ours, tmp_path / "run").finished


def test_a_method_of_ones_own_needs_known_phases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(METHODS, "_entries", dict(METHODS._entries))
    register_method("mine", Method("Mine", "of one's own", ("model", "dream", "evaluate")))
    with pytest.raises(ConfigError, match=r"'mine' has \['dream'\]"):
        run(replace(CONFIG, method="mine", phases=None), tmp_path / "run")
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match="'mine' is registered already"):
        register_method("mine", METHODS["mine"])
    with pytest.raises(ConfigError, match="acting: expected one of"):
        Method("Mine", "of one's own", ("model",), acting="guess")
