"""Phase 1: what it counts, keeps, learns and resumes, to the bit."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
from torchrl.envs import GymWrapper, StepCounter, TransformedEnv

from phihp_torchrl.dynamics import FitConfig, split
from phihp_torchrl.trainers import ModelTrainer, make_dynamics, model_fit
from phihp_torchrl.worlds import SimulatedWorld

from .trainer_parts import ADAM, MODEL, PENDULUM, SHORT, assert_same_state, plain

WORLD = SimulatedWorld(PENDULUM)


def test_real_steps_are_counted_exactly():
    trainer = ModelTrainer(SHORT, MODEL, seed=0)
    assert trainer.progress == (0, 70)
    assert not trainer.done
    counts = []
    while not trainer.done:
        metrics = trainer.advance()
        counts.append(metrics["real_steps"])
        assert len(trainer.data) == trainer.real_steps == metrics["real_steps"]
    assert counts == [25, 50, 70]
    assert trainer.iteration == MODEL.iterations == 3
    assert trainer.states().shape == (70, 2)


def test_no_more_steps_are_taken_than_counted():
    env = SimulatedWorld(SHORT).make_env()
    taken = []
    step = env.base_env._step

    def counted(tensordict):
        taken.append(tensordict["action"].clone())
        return step(tensordict)

    env.base_env._step = counted
    trainer = ModelTrainer(SHORT, MODEL, seed=0, world=env)
    while not trainer.done:
        trainer.advance()
    assert len(taken) == 70
    torch.testing.assert_close(trainer.data["action"], torch.stack(taken).float())


def test_data_are_real_and_in_order():
    trainer = ModelTrainer(SHORT, MODEL, seed=0)
    while not trainer.done:
        trainer.advance()
    data, locate = trainer.data, SHORT.locate
    state, action = locate(data["observation"]), data["action"]
    observation = data["next", "observation"]
    expected = SHORT.observe(SimulatedWorld(SHORT).step(state, action))
    torch.testing.assert_close(observation, expected, rtol=1e-4, atol=1e-4)
    reward = SHORT.reward(state, action, locate(observation))
    torch.testing.assert_close(data["next", "reward"][:, 0], reward, rtol=1e-4, atol=1e-4)
    goes_on = ~data["next", "done"][:-1, 0]
    assert torch.equal(observation[:-1][goes_on], data["observation"][1:][goes_on])
    jumps = (observation[:-1] != data["observation"][1:]).any(-1).nonzero().flatten().tolist()
    # Episodes of 15 steps, and a new one for each of the iterations, of 25, 25 and 20 steps.
    assert jumps == [14, 24, 39, 49, 64]


def test_the_seed_makes_the_run():
    def states(seed):
        torch.manual_seed(0)  # of the networks' weights
        trainer = ModelTrainer(SHORT, MODEL, seed=seed)
        for _ in range(2):
            trainer.advance()
        return trainer.states()

    first = states(0)
    assert torch.equal(first, states(0))
    assert not torch.equal(first, states(1))


@pytest.mark.parametrize("kind", ["hybrid", "data_driven", "prior", "oracle"])
def test_metrics(kind):
    trainer = ModelTrainer(SHORT, replace(MODEL, kind=kind), seed=0)
    metrics = trainer.advance()
    assert all(isinstance(value, float) and math.isfinite(value) for value in metrics.values())
    expected = {"real_steps", "collect/reward", "collect/return"}
    if kind != "oracle":
        names = ("train_error", "held_out_error", "fit_steps", "fit_seconds", "lambda")
        expected |= {f"model/{name}" for name in (*names, "residual_share")}
    if kind in ("hybrid", "prior"):
        expected |= {"constants/gravity_gain", "constants/torque_gain"}
    assert set(metrics) == expected
    if kind == "hybrid":
        constants = trainer.dynamics.prior.constants()
        gain = 1.5 * constants["gravity"] / constants["length"]
        assert metrics["constants/gravity_gain"] == pytest.approx(gain.item())


def test_the_model_gets_better():
    config = replace(
        MODEL, real_steps=100, steps_per_iteration=100, hidden_sizes=(8,), fit=FitConfig(steps=20)
    )
    trainer = ModelTrainer(PENDULUM, config, seed=0)
    untrained = copy.deepcopy(trainer.dynamics)
    trainer.advance()
    state = PENDULUM.reset.sample([50])
    action = torch.zeros(50, 1)
    truth = WORLD.step(state, action)
    before, after = ((m(state, action) - truth).norm() for m in (untrained, trainer.dynamics))
    assert after < 0.1 * before


@pytest.mark.parametrize(
    ("config", "done_before"),
    [(MODEL, 0), (MODEL, 1), (MODEL, 2), (ADAM, 1), (replace(MODEL, warm_start=False), 1)],
)
def test_a_resumed_model_run_is_the_same_run(config, done_before):
    torch.manual_seed(0)
    whole = ModelTrainer(SHORT, config, seed=0)
    torch.manual_seed(0)
    first = ModelTrainer(SHORT, config, seed=0)
    for _ in range(done_before):
        whole.advance()
        first.advance()
    saved = copy.deepcopy(first.state_dict())
    plain(saved)
    torch.manual_seed(7)
    resumed = ModelTrainer(SHORT, config, seed=7)
    resumed.load_state_dict(saved)
    assert_same_state(saved, resumed.state_dict())
    assert resumed.progress == first.progress
    while not whole.done:
        expected, metrics = whole.advance(), resumed.advance()
        assert {k: v for k, v in metrics.items() if "seconds" not in k} == {
            k: v for k, v in expected.items() if "seconds" not in k
        }
    assert resumed.done
    assert_same_state(whole.state_dict(), resumed.state_dict())


def test_cold_fits_begin_at_the_beginning():
    config = replace(MODEL, warm_start=False, fit=replace(ADAM.fit, learning_rate=1e-12))
    trainer = ModelTrainer(SHORT, config, seed=0)
    start = trainer.dynamics.prior.log_constants.detach().clone()
    trainer.advance()
    with torch.no_grad():
        trainer.dynamics.prior.log_constants.add_(1.0)
    trainer.advance()
    torch.testing.assert_close(trainer.dynamics.prior.log_constants.detach(), start)


def test_first_guess_is_wrong_by_the_error():
    generator = torch.Generator().manual_seed(0)
    dynamics = make_dynamics(WORLD, replace(MODEL, constants_error=0.2), generator)
    for name, value in dynamics.prior.constants().items():
        ratio = value.item() / WORLD.truth.constants[name]
        assert abs(ratio - 1) == pytest.approx(0.2, rel=1e-4)


def test_custom_environment():
    inner = SimulatedWorld(SHORT).make_env().base_env._env
    env = TransformedEnv(GymWrapper(inner), StepCounter())
    trainer = ModelTrainer(SHORT, MODEL, seed=0, world=env)
    trainer.advance()
    assert trainer.real_steps == 25


def test_iterations_are_not_joined_to_one_block():
    # Blocks [180, 200) with a boundary between iterations at 190.
    config = replace(MODEL, real_steps=200, steps_per_iteration=95, kind="oracle")
    trainer = ModelTrainer(PENDULUM, config, seed=0)
    while not trainer.done:
        trainer.advance()
    *_, blocks = split(trainer.data)
    assert blocks is None


def finished(config, seed=0):
    torch.manual_seed(0)  # of the networks' weights
    trainer = ModelTrainer(SHORT, config, seed=seed)
    while not trainer.done:
        metrics = trainer.advance()
    return trainer, metrics


@pytest.fixture
def open_data(monkeypatch):
    """No data are taken to pin the model down."""
    monkeypatch.setattr(model_fit, "_PINNED", 0.0)


@pytest.mark.usefixtures("open_data")
def test_the_last_fit_is_tried_from_other_first_weights():
    once, before = finished(replace(MODEL, restarts=0))
    again, after = finished(MODEL)
    assert once.others() == []
    assert after["model/held_out_error"] <= before["model/held_out_error"]
    assert after["model/fit_steps"] == 3 * before["model/fit_steps"]
    assert torch.equal(again.states(), once.states())  # no fit before the last is another
    state, action = again.states()[:5], torch.zeros(5, 1)
    assert len(again.others()) == 2
    for other in again.others():
        assert not torch.equal(other(state, action), again.dynamics(state, action))
    resumed = ModelTrainer(SHORT, MODEL, seed=1)
    resumed.load_state_dict(again.state_dict())
    for mine, theirs in zip(resumed.others(), again.others(), strict=True):
        assert torch.equal(mine(state, action), theirs(state, action))


@pytest.mark.usefixtures("open_data")
@pytest.mark.parametrize("change", [{"ensemble": 2}, {"kind": "prior"}, {"fit": ADAM.fit}])
def test_what_has_no_single_residual_or_is_fitted_slowly_is_fitted_once(change):
    trainer, _ = finished(replace(MODEL, **change))
    assert trainer.others() == []


def test_what_the_data_pin_down_is_fitted_once():
    """After two steps all errors are alike, on fitted transitions and on held-out ones."""
    trainer, metrics = finished(MODEL)
    assert 1e-8 < metrics["model/held_out_error"] < 2 * metrics["model/train_error"]
    assert trainer.others() == []
