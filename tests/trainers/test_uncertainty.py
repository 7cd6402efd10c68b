"""An ensemble and drawn constants in runs: who imagines with what, and what is refused."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch

from phihp_torchrl import HybridDynamics
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import EnsembleResidual, per_life
from phihp_torchrl.trainers import ModelConfig, ModelTrainer, PolicyConfig, read_run_config, run

from .run_parts import CONFIG, MODEL, POLICY
from .trainer_parts import MODEL as SMALL_MODEL
from .trainer_parts import PENDULUM, assert_same_state, plain, policy_trainer, stored
from .trainer_parts import POLICY as SMALL_POLICY

DRAWN = replace(SMALL_POLICY, draw_constants=True)
COVARIANCE = 0.01 * torch.eye(3)


def train(trainer):
    while not trainer.done:
        metrics = trainer.advance()
    return metrics


def test_the_model_phase_learns_an_ensemble_and_tells_how_sure_it_is():
    torch.manual_seed(0)
    trainer = ModelTrainer(PENDULUM, replace(SMALL_MODEL, ensemble=2), seed=0)
    with pytest.raises(ConfigError, match=r"^real_steps: expected real steps that were fitted"):
        trainer.constants_covariance()
    train(trainer)
    assert isinstance(trainer.dynamics.residual, EnsembleResidual)
    covariance = trainer.constants_covariance()
    assert covariance.shape == (3, 3)
    assert (torch.linalg.eigvalsh(covariance.double()) > -1e-8).all()
    assert 0 < covariance.diagonal().max() < 0.25  # a standard deviation below a half


def test_imagined_transitions_are_those_of_each_worlds_model():
    dynamics = HybridDynamics.hybrid(PENDULUM, ensemble=2)
    trainer = policy_trainer(DRAWN, dynamics=dynamics, covariance=COVARIANCE)
    train(trainer)
    batch = stored(trainer.learner.replay)
    view = per_life(dynamics, trainer.shifts)
    rows = len(batch.state) // DRAWN.num_worlds * DRAWN.num_worlds
    folded = [part[:rows].reshape(-1, DRAWN.num_worlds, part.shape[-1]) for part in batch[:2]]
    expected = torch.cat([view(state, action) for state, action in zip(*folded, strict=True)])
    torch.testing.assert_close(batch.next_state[:rows], expected)
    assert not torch.allclose(expected, dynamics(batch.state[:rows], batch.action[:rows]))


def test_without_draws_nothing_is_drawn_or_kept():
    trainer = policy_trainer()
    assert trainer.shifts is None
    assert "shifts" not in trainer.state_dict()


def test_draws_leave_all_other_random_numbers_as_they_are():
    plain_one, drawn = policy_trainer(), policy_trainer(DRAWN, covariance=0 * COVARIANCE)
    assert train(plain_one).keys() == train(drawn).keys()
    for one, other in zip(
        stored(plain_one.learner.replay), stored(drawn.learner.replay), strict=True
    ):
        torch.testing.assert_close(one, other)


def test_a_std_of_ones_own_takes_the_place_of_the_fits():
    config = replace(DRAWN, constants_std=0.1, num_worlds=256)
    shifts = policy_trainer(config).shifts
    assert shifts.shape == (256, 3)
    assert 0.07 < shifts.std() < 0.1  # cut off at 95 %
    assert shifts.abs().max() <= 0.1961


def test_a_resumed_run_imagines_with_the_same_constants():
    whole = policy_trainer(DRAWN, covariance=COVARIANCE)
    whole.advance()
    saved = copy.deepcopy(whole.state_dict())
    plain(saved)
    dynamics = copy.deepcopy(whole.world_model.transitions.prior.prior)
    base = HybridDynamics(PENDULUM, prior=dynamics, residual=whole.world_model.transitions.residual)
    # As if the covariance had come out otherwise on another machine.
    resumed = policy_trainer(DRAWN, seed=7, dynamics=base, covariance=2 * COVARIANCE)
    resumed.load_state_dict(saved)
    assert_same_state(saved, resumed.state_dict())
    expected, metrics = train(whole), train(resumed)
    assert metrics["policy/imagined_return"] == expected["policy/imagined_return"]
    assert_same_state(whole.state_dict(), resumed.state_dict(), but=["seconds"])


def test_a_whole_run_with_both(tmp_path):
    sections = {
        **CONFIG.sections,
        "model": replace(MODEL, ensemble=2),
        "policy": replace(POLICY, draw_constants=True),
    }
    result = run(replace(CONFIG, sections=sections), tmp_path / "run")
    assert result.finished
    assert (result.path / "evaluation.json").is_file()


@pytest.mark.parametrize("kind", ["prior", "oracle"])
def test_an_ensemble_of_no_residuals_is_refused(kind):
    with pytest.raises(ConfigError, match=r"^ensemble: expected 1 for a model of kind"):
        ModelConfig(kind=kind, ensemble=2)


@pytest.mark.parametrize("ensemble", [0, -1, 2.5])
def test_an_ensemble_that_cannot_be_is_named(ensemble):
    with pytest.raises(ConfigError, match=r"^ensemble: expected a whole number"):
        ModelConfig(ensemble=ensemble)


def test_a_std_without_draws_or_below_zero_is_named():
    with pytest.raises(ConfigError, match=r"^constants_std: expected null without"):
        PolicyConfig(constants_std=0.1)
    with pytest.raises(ConfigError, match=r"^constants_std: expected a positive number"):
        PolicyConfig(draw_constants=True, constants_std=-0.1)


def test_constants_that_are_not_there_are_not_drawn():
    with pytest.raises(ConfigError, match=r"^policy\.draw_constants: expected the covariance"):
        policy_trainer(DRAWN)
    with pytest.raises(ConfigError, match=r"^policy\.draw_constants: expected false"):
        policy_trainer(DRAWN, dynamics=HybridDynamics.data_driven(PENDULUM), covariance=COVARIANCE)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": {"kind": "data_driven"}}, r"^policy\.draw_constants: expected false"),
        (
            {"model": {"integrator": "dopri5", "fit": {"method": "adam"}}},
            r"^policy\.constants_std: expected a number",
        ),
    ],
)
def test_a_run_that_cannot_draw_is_refused_before_any_real_step(changes, message, tmp_path):
    settings = {"task": "pendulum", "policy": {"draw_constants": True}, **changes}
    with pytest.raises(ConfigError, match=message):
        run(read_run_config(settings), tmp_path / "run")
    assert not (tmp_path / "run").exists()
