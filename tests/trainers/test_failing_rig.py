"""A rig that fails in the middle of collection: no step before that is lost, and it goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torchrl.envs import Transform, TransformedEnv

from phihp_torchrl import ConfigError, RunConfig, run
from phihp_torchrl.dynamics import FitConfig
from phihp_torchrl.trainers import ModelConfig, ModelTrainer
from phihp_torchrl.worlds import EnvWorld, SimulatedWorld

from .trainer_parts import COLLECT, PENDULUM

CONFIG = ModelConfig(
    real_steps=60,
    steps_per_iteration=30,
    hidden_sizes=(4,),
    integrator="semi_implicit_euler",
    fit=FitConfig(steps=1),
    collect=COLLECT,
)


class Rig(Transform):
    """Counts the steps of all environments, and does something at some of them."""

    def __init__(self, at: Callable[[int, Any], Any]) -> None:
        super().__init__()
        self.at, self.steps = at, 0
        plain = SimulatedWorld(PENDULUM).make_env()
        self.__dict__["env"] = TransformedEnv(plain, self, auto_unwrap=False)

    def _step(self, tensordict, next_tensordict):
        self.steps += 1
        self.at(self.steps, next_tensordict)
        return next_tensordict


def failing_at(*steps: int) -> Rig:
    def at(step: int, td: Any) -> None:
        if step in steps:
            raise OSError("no answer")

    return Rig(at)


def blind_from(first: int, last: int) -> Rig:
    def at(step: int, td: Any) -> None:
        if first <= step <= last:
            td["observation"] = torch.full_like(td["observation"], torch.nan)

    return Rig(at)


def world_of(rig: Rig) -> EnvWorld:
    """A world of the one environment that a rig has."""
    return EnvWorld(PENDULUM, rig.env)


def finish(trainer: ModelTrainer) -> None:
    while not trainer.done:
        trainer.advance()


@pytest.mark.parametrize("step", [2, 30, 31])
def test_an_environment_that_fails_loses_no_step_before(step: int) -> None:
    rig = failing_at(step)
    trainer = ModelTrainer(PENDULUM, CONFIG, seed=0, world=world_of(rig))
    kept: list[int] = []
    trainer.keep = lambda: kept.append(trainer.real_steps)
    message = r"^world: .*failed at step \d+ of 30: OSError: no answer"
    with pytest.raises(ConfigError, match=message):
        finish(trainer)
    assert trainer.real_steps == kept[-1] == step - 1
    other = ModelTrainer(PENDULUM, CONFIG, seed=0, world=world_of(rig))
    other.load_state_dict(trainer.state_dict())
    finish(other)
    assert (other.real_steps, rig.steps, other.iteration) == (60, 61, 2)
    assert other.data["observation"].isfinite().all()


def test_a_failure_at_the_first_step_says_so_and_can_be_tried_again() -> None:
    rig = failing_at(1)
    trainer = ModelTrainer(PENDULUM, CONFIG, seed=0, world=world_of(rig))
    with pytest.raises(ConfigError, match=r"failed at step 0 of 30: OSError"):
        trainer.advance()
    trainer.advance()
    assert trainer.real_steps == 30


@pytest.mark.parametrize("first", [1, 8, 20])
def test_a_sensor_that_goes_blind_loses_no_step_before(first: int, tmp_path) -> None:
    rig = blind_from(first, 30)
    settings = RunConfig(
        "pendulum",
        phases=("model",),
        progress=False,
        checkpoint_interval=1e9,
        sections={"model": CONFIG},
    )
    with pytest.raises(ConfigError, match=rf"real steps have missing .*first at step {first - 1}"):
        run(settings, tmp_path / "run", world=world_of(rig))
    result = run(settings, tmp_path / "run", resume=True, world=world_of(rig))
    assert result.finished
    assert rig.steps == 60
    assert (result.metrics["collect/dropped"], len(list((tmp_path / "run").iterdir())) > 2) == (
        31 - first,
        True,
    )


def test_one_missing_number_is_left_out_as_before(caplog) -> None:
    trainer = ModelTrainer(PENDULUM, CONFIG, seed=0, world=world_of(blind_from(5, 5)))
    trainer.advance()
    assert (trainer.real_steps, len(trainer.data)) == (30, 28)
    assert "2 of 30 real steps are left out" in caplog.text


def test_an_interrupt_is_no_failure_of_the_environment() -> None:
    def at(step: int, td: Any) -> None:
        if step == 5:
            raise KeyboardInterrupt

    trainer = ModelTrainer(PENDULUM, replace(CONFIG), seed=0, world=world_of(Rig(at)))
    with pytest.raises(KeyboardInterrupt):
        trainer.advance()
