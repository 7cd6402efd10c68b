"""Commands that act late in a world of which nobody said so: phase 1 finds out, and goes on."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from phihp_torchrl import get_task, load_agent
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import FitConfig
from phihp_torchrl.recordings import Recording
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.trainers import ModelConfig, ModelTrainer, run
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld
from tests.trainers.run_parts import CONFIG
from tests.trainers.trainer_parts import COLLECT, PENDULUM

ONE = ModelConfig(
    real_steps=240,
    steps_per_iteration=120,
    kind="prior",
    hidden_sizes=(4,),
    integrator="semi_implicit_euler",
    fit=FitConfig(steps=8),
    collect=COLLECT,
)
TASK = replace(PENDULUM, name="late-pendulum", max_steps=40)


def world(**actuator: float) -> SimulatedWorld:
    """A world without friction, which a prior alone describes."""
    return SimulatedWorld(TASK, SimulatedConfig(actuator=actuator, friction={"joint": 0.0}))


def trainer(config: ModelConfig = ONE, seed: int = 0, **actuator: float) -> ModelTrainer:
    return ModelTrainer(TASK, config, seed=seed, world=world(**actuator))


@pytest.mark.parametrize("drive", [Actuator(2.0), Actuator(1.0, lag=0.06)], ids=str)
def test_dead_time_and_lag_are_found_and_said(drive, caplog):
    late = trainer(**drive.config)
    late.advance()
    found = late.task.actuator
    assert found.delay_steps == pytest.approx(drive.delay_steps, abs=0.05)
    assert found.lag == pytest.approx(drive.lag, rel=0.1, abs=1e-9)
    said = [r.message for r in caplog.records if "act late" in r.message]
    assert len(said) == 1
    assert all(f"actuator.{name}=" in said[0] for name in drive.config)
    metrics = late.advance()  # plans know what is under way, and the fit is as good as without
    assert metrics["model/held_out_error"] < 1e-2
    states = late.states()
    assert states.shape == (240, late.task.state_dim)
    assert states.isfinite().all()


def test_what_is_under_way_is_that_of_the_world():
    late = trainer(delay_steps=1.0)
    late.advance()
    late.advance()
    batch = late.transitions()
    torch.testing.assert_close(batch.next_state[:, -1:], batch.action, rtol=0, atol=1e-6)
    starts = late.data["next", "done"].flatten().roll(1)
    starts[0] = True
    assert (batch.state[starts, -1] == 0).all()
    assert starts.sum() > 4


@pytest.mark.parametrize("kind", ["hybrid", "prior", "data_driven"])
def test_friction_alone_is_no_actuator(kind, caplog):
    """With friction in the world; a prior alone cannot tell it, and blames no command."""
    still = ModelTrainer(TASK, replace(ONE, kind=kind), seed=0, world="simulated")
    still.advance()
    assert still.task is TASK
    assert not [r for r in caplog.records if "ommands" in r.message]


def test_none_keeps_it_off(caplog):
    off = trainer(replace(ONE, actuator="none"), delay_steps=2.0)
    off.advance()
    assert off.task.actuator is None
    assert "step_count" not in off.data
    assert not [r for r in caplog.records if "act late" in r.message]
    with pytest.raises(ConfigError, match="actuator"):
        replace(ONE, actuator="perhaps")


def test_what_the_user_says_is_kept():
    told = replace(TASK, actuator=Actuator(delay_steps=1.0))
    late = ModelTrainer(told, ONE, seed=0, world=SimulatedWorld(told))
    late.advance()
    assert late.task is told


def test_adam_warns_and_says_which_setting(caplog):
    config = replace(ONE, fit=FitConfig(method="adam", steps=60, learning_rate=0.02))
    late = trainer(config, delay_steps=2.0)
    late.advance()
    assert late.task.actuator is None
    assert any("actuator.delay_steps" in r.message for r in caplog.records)


def test_a_resumed_trainer_knows_the_actuator():
    torch.manual_seed(0)
    whole = trainer(delay_steps=1.0)
    whole.advance()
    saved = copy.deepcopy(whole.state_dict())
    resumed = trainer(seed=7, delay_steps=1.0)
    resumed.load_state_dict(saved)
    assert resumed.task.actuator == Actuator(delay_steps=1.0)
    expected, metrics = whole.advance(), resumed.advance()
    assert metrics["model/held_out_error"] == expected["model/held_out_error"]


def test_recordings_tell_it_too():
    torch.manual_seed(0)
    task, given = replace(TASK, max_steps=200), iter(4.0 * torch.rand(150, 1) - 2.0)
    env = SimulatedWorld(task, SimulatedConfig(actuator={"delay_steps": 1.0})).make_env()
    seen = env.rollout(149, lambda td: td.set("action", next(given)))
    state = task.locate(seen["observation"])
    log = Recording(torch.arange(149) * task.time_step, state, seen["action"])
    known = ModelTrainer(task, ONE, seed=0, world=[log])
    known.advance()
    assert known.done
    assert known.task.actuator == Actuator(delay_steps=1.0)


def test_a_run_goes_on_with_it_to_the_agent(tmp_path: Path):
    model = replace(ONE, real_steps=160, steps_per_iteration=160)
    config = replace(CONFIG, sections={**CONFIG.sections, "model": model})
    rig = SimulatedWorld(get_task(config.task), SimulatedConfig(actuator={"delay_steps": 1.0}))
    result = run(config, tmp_path / "run", world=rig)
    assert result.finished
    assert rig.task.actuator is None
    found = load_agent(tmp_path / "run" / "agent").task.actuator
    assert found.delay_steps == pytest.approx(1.0, abs=0.1)
