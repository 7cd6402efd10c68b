"""Phase 2 by gradients through the model: what it counts, warns of and resumes, to the bit."""

from __future__ import annotations

import copy
import logging
import math
from dataclasses import replace

import pytest
import torch

from phihp_torchrl import HybridDynamics
from phihp_torchrl.agents import AnalyticConfig, RefitConfig
from phihp_torchrl.config import ConfigError, to_mapping
from phihp_torchrl.tasks import Signal
from phihp_torchrl.trainers import LEARNERS, PolicyConfig, PolicyTrainer, register_learner
from phihp_torchrl.worlds import SimulatedWorld

from .trainer_parts import PENDULUM, POLICY, assert_same_state, plain, policy_trainer

ANALYTIC = replace(
    POLICY, method="analytic", analytic=AnalyticConfig(horizon=4, critic_updates=2), max_age=7
)


def test_a_resumed_run_is_the_same_run():
    whole, first = policy_trainer(ANALYTIC), policy_trainer(ANALYTIC)
    whole.advance()
    first.advance()
    saved = copy.deepcopy(first.state_dict())
    plain(saved)
    dynamics = copy.deepcopy(first.world_model.transitions)
    resumed = policy_trainer(ANALYTIC, seed=7, dynamics=dynamics)
    resumed.load_state_dict(saved)
    while not whole.done:
        expected, metrics = whole.advance(), resumed.advance()
        for key in expected.keys() - {"policy/seconds"}:
            assert metrics[key] == expected[key], key
    assert_same_state(whole.state_dict(), resumed.state_dict(), but=["seconds"])


def test_a_horizon_may_be_given_in_seconds() -> None:
    horizon = f"{4 * PENDULUM.time_step} s"
    config = replace(ANALYTIC, analytic=replace(ANALYTIC.analytic, horizon=horizon))
    assert policy_trainer(config).config == ANALYTIC


def test_work_is_counted():
    trainer = policy_trainer(ANALYTIC, world=SimulatedWorld(PENDULUM))
    counts = []
    while not trainer.done:
        metrics = trainer.advance()
        counts.append((metrics["policy/updates"], metrics["policy/imagined_steps"]))
        assert all(math.isfinite(value) for value in metrics.values())
    # Four worlds, four steps, two critic updates in each round.
    assert counts == [(4, 32), (8, 64), (12, 96)]
    assert trainer.progress == (12, 12)
    assert {"policy/limited_share", "policy/gradient_norm", "policy/real_return"} <= set(metrics)


def test_old_lives_start_anew():
    trainer = policy_trainer(replace(ANALYTIC, num_worlds=50))
    ages = trainer.learner.worlds.age
    assert ages.unique().tolist() == list(range(7))
    before = trainer.learner.worlds
    trainer.learner._go_on(before.state, torch.zeros(4 * 50, dtype=torch.bool))
    old = before.age >= 3
    assert (trainer.learner.worlds.age[old] == 0).all()
    assert torch.equal(trainer.learner.worlds.age[~old], before.age[~old] + 4)
    assert torch.equal(trainer.learner.worlds.state[~old], before.state[~old])
    assert not torch.equal(trainer.learner.worlds.state[old], before.state[old])
    ended = torch.zeros(4, 50, dtype=torch.bool)
    ended[2] = True
    trainer.learner._go_on(before.state, ended.flatten())
    assert (trainer.learner.worlds.age == 1).all()


def following() -> PolicyTrainer:
    """A trainer whose task has a reference that moves."""

    def towards(state, action, next_state, reference):
        return -(next_state[..., 0] - reference[..., 0]).square()

    aim = Signal(("theta",), (-1.0,), (1.0,), preview=1)
    task = replace(PENDULUM, reference=aim, reward=towards)
    torch.manual_seed(0)
    return PolicyTrainer(task, HybridDynamics.hybrid(task), ANALYTIC, seed=0)


def test_references_go_on_through_all_lives():
    trainer = following()
    learner, stream = trainer.learner, copy.deepcopy(trainer.learner.stream)
    signals = torch.cat([stream.present()[None], stream.advance(12)])
    learner.learn(6)  # three rounds of four steps
    rows = learner.replay.rows[: len(learner.replay)].split(learner.replay.sizes, -1)
    outside = trainer.task.outside
    for part, expected in ((rows[0], signals[:-1]), (rows[3], signals[1:])):
        state = part.view(12, ANALYTIC.num_worlds, -1)
        torch.testing.assert_close(state[..., -outside.size :], expected)
    torch.testing.assert_close(learner.worlds.state[:, -outside.size :], signals[-1])
    assert (signals.std(0) > 0).any(0).all()  # they moved
    assert (learner.worlds.age < 7).all()


def test_a_resumed_run_meets_the_same_references():
    whole, resumed = following(), following()
    whole.advance()
    resumed.load_state_dict(copy.deepcopy(whole.state_dict()))
    assert whole.advance()["policy/imagined_return"] == resumed.advance()["policy/imagined_return"]
    assert torch.equal(whole.learner.worlds.state, resumed.learner.worlds.state)


def test_critics_are_fitted_to_the_returns_for_the_planner():
    refit = RefitConfig(start=0, interval=4, transitions=256, horizon=5, steps=50, batch_size=64)
    trainer = policy_trainer(replace(ANALYTIC, refit=refit))
    while not trainer.done:
        metrics = trainer.advance()
    assert metrics["policy/critic_error"] < metrics["policy/critic_error_before"]
    state, action = trainer.learner.visited(200)
    assert state.shape == (200, 2)
    assert action.min() < -1.5
    assert action.max() > 1.5
    assert set(trainer.parts()) == {"actor", "qvalue"}


def test_limited_gradients_are_warned_of(caplog):
    with caplog.at_level(logging.WARNING):
        policy_trainer(ANALYTIC).advance()
        assert not caplog.records
        tight = replace(ANALYTIC.analytic, step_limit=1e-9)
        policy_trainer(replace(ANALYTIC, analytic=tight)).advance()
    assert "chaotic" in caplog.text
    assert "policy.method=td3" in caplog.text


def test_a_model_that_explodes_keeps_the_first_actor():
    class Explosive(torch.nn.Module):
        def forward(self, state, action):
            return torch.full_like(state, math.nan)

    trainer = policy_trainer(ANALYTIC, dynamics=Explosive())
    first = [layer.clone() for layer in trainer.update.actor]
    trainer.advance()
    kept = list(trainer.best_actor().parameters())
    assert all(torch.equal(a, b) for a, b in zip(first, kept, strict=True))


def test_members_of_an_ensemble_live_in_their_rows():
    dynamics = HybridDynamics.hybrid(PENDULUM, ensemble=2)
    assert math.isfinite(policy_trainer(ANALYTIC, dynamics=dynamics).advance()["policy/updates"])


def test_another_way_is_one_entry(monkeypatch):
    monkeypatch.setattr(LEARNERS, "_entries", dict(LEARNERS))
    built = []

    def build(imagination):
        built.append(imagination)
        return LEARNERS["td3"].build(imagination)

    register_learner("mine", build)
    trainer = policy_trainer(replace(POLICY, method="mine"))
    assert built[0].world_model is trainer.world_model
    trainer.advance()
    assert trainer.progress == (4, 12)


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"method": "ppo"}, "method"),
        ({"updates": 13}, "updates"),
        ({"evaluation_interval": 3, "updates": 12}, "evaluation_interval"),
        ({"num_worlds": 1, "analytic": AnalyticConfig(horizon=3, critic_updates=2)}, "num_worlds"),
    ],
)
def test_settings_that_do_not_fit_are_refused(changes, key):
    with pytest.raises(ConfigError, match=key):
        replace(ANALYTIC, **changes)


@pytest.mark.parametrize("name", ["trace", "tau", "noise", "entropy", "step_limit", "norm_limit"])
def test_numbers_out_of_range_are_refused(name):
    with pytest.raises(ConfigError, match=name):
        AnalyticConfig(**{name: -1.0})


def test_td3_is_the_default():
    assert PolicyConfig().method == "td3"
    assert to_mapping(PolicyConfig())["analytic"]["horizon"] == 16
