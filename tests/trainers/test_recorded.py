"""Phase 1 from recordings alone, and real steps that cannot be used or whose fit fails."""

from __future__ import annotations

import copy
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from phihp_torchrl import HybridDynamics, Signal, load_agent
from phihp_torchrl.config import METHODS, ConfigError
from phihp_torchrl.dynamics import FitConfig
from phihp_torchrl.recordings import Recording
from phihp_torchrl.trainers import (
    CollectConfig,
    ModelTrainer,
    RunConfig,
    read_result,
    record,
    run,
)
from phihp_torchrl.trainers.checkpoints import load_state
from phihp_torchrl.trainers.phases import PHASES, unknown_phases
from phihp_torchrl.worlds import RecordedWorld, SimulatedWorld, make_world
from tests.followed import WIND, Mass, followed

from .run_parts import CONFIG, Crash, assert_equal, rows
from .trainer_parts import MODEL, PENDULUM, SHORT, assert_same_state


def recorded(count: int = 150, jitter: float = 0.0) -> RecordedWorld:
    """Recordings of a frictionless pendulum under random torques, by a clock that may jitter."""
    truth = HybridDynamics.pure_prior(PENDULUM, constants={"mass": 1.3}, integrator="rk4").double()
    logs = []
    for episode in range(2):
        state, states = PENDULUM.reset.sample([]).double(), []
        seconds = PENDULUM.time_step * (1.0 + jitter * (2.0 * torch.rand(count, 1) - 1.0)).double()
        actions = 4.0 * torch.rand(count, 1).double() - 2.0
        for action, step in zip(actions, seconds, strict=True):
            states.append(state)
            with torch.no_grad():
                state = truth(state, action, step)
        time = torch.cat([seconds.new_zeros(1), seconds[:-1, 0].cumsum(0)])
        logs.append(Recording(time, torch.stack(states), actions, episode=episode))
    return RecordedWorld(PENDULUM, logs)


@pytest.mark.parametrize("jitter", [0.0, 0.5])
def test_phase_1_takes_all_transitions_and_fits_once(jitter: float) -> None:
    config = replace(MODEL, kind="prior", integrator="rk4", fit=FitConfig(steps=20))
    trainer = ModelTrainer(PENDULUM, config, seed=0, world=recorded(jitter=jitter))
    assert trainer.progress == (0, 298)
    metrics = trainer.advance()
    assert trainer.done
    assert trainer.progress == (298, 298)
    assert ("time_step" in trainer.data.keys()) == (jitter > 0)  # noqa: SIM118
    system = PENDULUM.system
    expected = system.identifiable({**system.constants, "mass": 1.3})
    for name, value in expected.items():
        assert metrics[f"constants/{name}"] == pytest.approx(value, rel=0.01), name
    assert trainer.states().shape == (298, 2)


def test_a_run_learns_from_recordings_and_plays_nowhere(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = replace(CONFIG, task="pendulum")
    with caplog.at_level(logging.WARNING):
        result = run(config, tmp_path / "run", world=recorded())
    assert result.finished
    assert caplog.text.count("saved without having played in it") == 1
    assert [row["phase"] for row in rows(tmp_path / "run")].count("model") == 1
    assert (tmp_path / "run" / "agent").is_dir()
    assert read_result(tmp_path / "run") is None
    assert run(config, tmp_path / "run", resume=True, world=recorded()).finished


def test_an_agent_that_follows_a_reference_is_learned_from_recordings(tmp_path: Path) -> None:
    def follow(state, action, next_state, reference):
        return -(next_state[..., 1] - reference[..., 0]).square()

    asked = Signal(("theta_dot",), low=(-1.0,), high=(1.0,), preview=1)
    task = replace(PENDULUM, name="follow", reward=follow, reference=asked)
    world = RecordedWorld(task, recorded().recordings)
    run(replace(CONFIG, task="follow"), tmp_path / "run", world=world)
    agent = load_agent(tmp_path / "run" / "agent", task=task)
    given = TensorDict(observation=torch.tensor([1.0, 0.0, 0.0]), reference=torch.tensor([0.5]))
    assert agent(given)["action"].isfinite().all()


def in_the_wind(mass: float, *, seen: float = 1.0, count: int = 600) -> RecordedWorld:
    """Recordings of a mass in the wind, of which ``seen`` times the truth was written down."""
    task, generator = followed(Mass()), torch.Generator().manual_seed(0)
    truth = HybridDynamics.pure_prior(task, constants={"mass": mass}, integrator="rk4").double()
    logs = []
    for episode in range(2):
        forces = 4.0 * torch.rand(count, 1, generator=generator).double() - 2.0
        wind = WIND.draw([], count, task.time_step, generator).double()
        forces -= 0.5 * wind  # as somebody commands who acts against it
        state, states = torch.zeros(2).double(), []
        for acting in torch.cat([forces, wind], -1):
            states.append(state)
            with torch.no_grad():
                state = truth(state, acting)
        time = task.time_step * torch.arange(count)
        log = Recording(time, torch.stack(states), forces, episode=episode, inputs=seen * wind)
        logs.append(log)
    return RecordedWorld(task, logs)


@pytest.mark.parametrize("seen", [1.0, 0.0])
def test_a_model_reckons_with_the_recorded_inputs(seen: float) -> None:
    fit = FitConfig(steps=20)
    config = replace(MODEL, kind="prior", integrator="rk4", actuator="none", fit=fit)
    world = in_the_wind(mass=1.3, seen=seen)
    trainer = ModelTrainer(world.task, config, seed=0, world=world)
    metrics = trainer.advance()
    assert trainer.done
    found = metrics["constants/mass"]
    if seen:
        assert found == pytest.approx(1.3, rel=0.01)
    else:  # half of the force seems to have done nothing
        assert found > 1.5 * 1.3


def test_an_agent_with_inputs_is_learned_from_recordings(tmp_path: Path) -> None:
    log = in_the_wind(mass=1.3, count=150).recordings[0]
    columns = torch.cat([log.time[:, None], log.state, log.action, log.inputs], -1)
    names = "time,x,x_dot,force,anemometer"
    np.savetxt(tmp_path / "log.csv", columns, delimiter=",", header=names, comments="")
    settings = {"files": str(tmp_path / "log.csv"), "columns": {"wind": "anemometer"}}
    world = make_world(followed(Mass()), {"kind": "recorded", **settings})
    assert torch.allclose(world.recordings[0].inputs, log.inputs)
    run(replace(CONFIG, task="followed"), tmp_path / "run", world=world)
    agent = load_agent(tmp_path / "run" / "agent", task=world.task)
    given = {"reference": torch.tensor([0.5]), "inputs": torch.tensor([1.0])}
    chosen = agent(TensorDict(observation=torch.zeros(2), **given))
    assert chosen["action"].isfinite().all()


def test_steps_that_were_recorded_have_their_inputs(tmp_path: Path) -> None:
    task = followed(Mass(), inputs=WIND)
    path = record(SimulatedWorld(task), CollectConfig(), 30, 0, tmp_path / "steps.csv")
    log = make_world(task, {"kind": "recorded", "files": str(path)}).recordings[0]
    speed, push = log.state[:, 1], (log.action + log.inputs)[:, 0]
    mass = push[:-1] * log.intervals / speed.diff()
    assert log.inputs.abs().amax() > 0.1
    torch.testing.assert_close(mass, torch.ones_like(mass), rtol=1e-2, atol=0)


def test_methods_that_act_are_refused(tmp_path: Path) -> None:
    acting = []
    for name, kind in METHODS.items():
        unknown_phases(kind.phases)
        if any(PHASES[phase].needs_env for phase in kind.phases):
            acting.append(name)
    assert {"td3", "td-mpc"} <= set(acting)
    for name in sorted({"td3", "td-mpc", "ph-td-mpc-star"} & set(acting)):
        with pytest.raises(ConfigError, match=r"method: .* has recordings alone"):
            run(RunConfig("pendulum", method=name), tmp_path / name, world=recorded())
        assert not (tmp_path / name).exists()


def faulty(world: SimulatedWorld, bad: Any) -> Any:
    """An environment of ``world`` whose sensor fails at the steps for which ``bad`` is true."""
    env, count = world.make_env(), 0
    step = env.base_env._step

    def fails(tensordict: TensorDictBase) -> TensorDictBase:
        nonlocal count
        assert tensordict["action"].isfinite().all()
        following = step(tensordict)
        count += 1
        if bad(count):
            following["observation"] = torch.full_like(following["observation"], torch.nan)
        return following

    env.base_env._step = fails
    return env


def test_steps_that_miss_a_number_are_left_out_and_the_run_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    env = faulty(SimulatedWorld(SHORT), lambda count: count % 20 == 5)
    trainer = ModelTrainer(SHORT, MODEL, seed=0, world=env)
    with caplog.at_level(logging.WARNING):
        while not trainer.done:
            metrics = trainer.advance()
    assert trainer.real_steps == 70
    assert trainer.data["observation"].isfinite().all()
    # The step that led to a missing state and, unless it was an episode's last, the one from there.
    assert 4 <= metrics["collect/dropped"] == 70 - len(trainer.data) <= 8
    assert "of 25 real steps are left out: missing or infinite numbers in" in caplog.text
    ends = trainer.data["next", "done"][:, 0].nonzero()[:, 0].tolist()
    assert 3 in ends  # before the fifth step


def test_a_sensor_that_is_broken_is_an_error() -> None:
    env = faulty(SimulatedWorld(SHORT), lambda count: count > 10)
    trainer = ModelTrainer(SHORT, MODEL, seed=0, world=env)
    with pytest.raises(ConfigError, match=r"world: \d+ of 25 real steps have missing or infinite"):
        trainer.advance()


def test_a_fit_that_fails_is_tried_again_on_the_same_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = replace(CONFIG, phases=("model",), checkpoint_interval=1000.0)
    run(config, tmp_path / "whole")
    fit, collect, collected = ModelTrainer.fit, ModelTrainer.collect, []

    def fail(self: ModelTrainer) -> Any:
        if self.iteration == 2:
            raise Crash
        return fit(self)

    def counted(self: ModelTrainer, steps: int) -> Any:
        collected.append(steps)
        return collect(self, steps)

    monkeypatch.setattr(ModelTrainer, "fit", fail)
    with pytest.raises(Crash):
        run(config, tmp_path / "run")
    monkeypatch.setattr(ModelTrainer, "fit", fit)
    monkeypatch.setattr(ModelTrainer, "collect", counted)
    assert run(config, tmp_path / "run", resume=True).finished
    assert collected == []
    assert rows(tmp_path / "run") == rows(tmp_path / "whole")
    states = [
        load_state(tmp_path / name / "phases" / "model", metadata={"task": config.task})
        for name in ("run", "whole")
    ]
    assert_equal(*states, "model")


def test_a_trainer_whose_fit_failed_goes_on_with_it() -> None:
    whole = ModelTrainer(SHORT, MODEL, seed=0)
    state: dict[str, Any] = {}
    whole.keep = lambda: state.update(copy.deepcopy(whole.state_dict()))
    whole.advance()
    again = ModelTrainer(SHORT, MODEL, seed=7)
    again.load_state_dict(state)
    assert not again.done
    again.advance()
    assert_same_state(again.state_dict(), whole.state_dict())
