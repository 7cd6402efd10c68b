"""Phase 2: what it counts, keeps and resumes, to the bit, and what has no say in it."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import HybridDynamics
from phihp_torchrl.agents import RefitConfig, act
from phihp_torchrl.config import ConfigError
from phihp_torchrl.imagination import Rollouts, StartConfig
from phihp_torchrl.trainers import PolicyTrainer
from phihp_torchrl.trainers.policy_evaluation import Played
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

from .trainer_parts import (
    PENDULUM,
    POLICY,
    assert_same_state,
    plain,
    policy_trainer,
)

WORLD = SimulatedWorld(PENDULUM)


@pytest.mark.parametrize("done_before", [0, 1, 2])
def test_a_resumed_policy_run_is_the_same_run(done_before):
    # Chunks of four updates, evaluations after six, so that a checkpoint may fall inside a chunk.
    config = replace(POLICY, updates=18, evaluation_interval=6)
    whole, first = policy_trainer(config), policy_trainer(config)
    dynamics = first.world_model.transitions
    for _ in range(done_before):
        whole.advance()
        first.advance()
    saved = copy.deepcopy(first.state_dict())
    plain(saved)
    resumed = policy_trainer(config, seed=7, dynamics=copy.deepcopy(dynamics))
    resumed.load_state_dict(saved)
    assert_same_state(saved, resumed.state_dict())
    while not whole.done:
        expected, metrics = whole.advance(), resumed.advance()
        for key in expected.keys() - {"policy/seconds"}:
            assert metrics[key] == expected[key], key
    assert resumed.done
    assert_same_state(whole.state_dict(), resumed.state_dict(), but=["seconds"])


def test_work_is_counted():
    trainer = policy_trainer(world=WORLD)
    assert trainer.progress == (0, 12)
    counts = []
    while not trainer.done:
        metrics = trainer.advance()
        counts.append((metrics["policy/updates"], metrics["policy/imagined_steps"]))
        assert all(math.isfinite(value) for value in metrics.values())
    # Two chunks of 2 steps in 4 worlds are random and precede the first; then one for 4 updates.
    assert counts == [(4, 24), (8, 32), (12, 40)]
    assert trainer.update.steps == 6, "of two critic updates each"
    assert set(metrics) == {
        f"policy/{name}"
        for name in (
            "updates",
            "imagined_steps",
            "imagined_return",
            "imagined_change",
            "best_imagined_return",
            "real_return",
            "seconds",
            "loss_qvalue",
            "loss_actor",
        )
    }


def test_the_best_actor_is_kept():
    rates = replace(POLICY.td3, actor_learning_rate=0.1)  # wild enough to get worse now and then
    trainer = policy_trainer(replace(POLICY, updates=40, td3=rates))
    returns, actors = [], []
    while not trainer.done:
        returns.append(trainer.advance()["policy/imagined_return"])
        actors.append([layer.clone() for layer in trainer.update.actor])
    best = max(range(len(returns)), key=returns.__getitem__)
    assert trainer.best_return == max(returns)
    kept = [p.detach() for p in trainer.best_actor().module.mlp.parameters()]
    for layer, expected in zip(kept, actors[best], strict=True):
        assert torch.equal(layer, expected)
    rollouts = Rollouts(trainer.world_model, act, max_age=5)
    score = rollouts.returns(kept, trainer.evaluation.states[:4], steps=5).total
    assert score.mean().item() == pytest.approx(trainer.best_return)


@pytest.mark.parametrize(
    ("first", "kept"),
    [(1.0, 1), (5.0, 3)],  # the calmest of those that earn most; the last, where none earns more
)
def test_of_equal_actors_the_calmest_is_kept(monkeypatch, first, kept):
    trainer = policy_trainer(replace(POLICY, updates=16, evaluation_interval=4))
    played = iter([(first, 0.5), (5.0, 0.1), (5.0, 0.4), (5.0, 0.1 if first > 1 else 0.2)])
    trainer.plateau = None

    def imagined(actor):
        earned, change = next(played)
        return Played(torch.full((2,), earned), change)

    monkeypatch.setattr(trainer.evaluation, "imagined", imagined)
    actors = []
    for _ in range(4):
        trainer.advance()
        actors.append(trainer.update.actor[0].clone())
    assert torch.equal(trainer.best[0], actors[kept])


def test_kept_actor_and_critics_stand_still():
    trainer = policy_trainer()
    trainer.advance()
    actor, critics = trainer.best_actor(), trainer.best_qvalue()
    before = [p.clone() for p in (*actor.parameters(), *critics.parameters())]
    while not trainer.done:
        trainer.advance()
    after = (*actor.parameters(), *critics.parameters())
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_actor_and_critics_are_modules_of_the_keys():
    trainer = policy_trainer()
    trainer.advance()
    data = trainer.best_actor()(TensorDict(observation=torch.randn(5, 3), batch_size=[5]))
    assert data["action"].shape == (5, 1)
    assert (data["action"].abs() <= 2).all()
    assert trainer.best_qvalue()(data)["state_action_value"].shape == (5, 2)
    current = trainer.actor()(TensorDict(observation=torch.randn(5, 3), batch_size=[5]))
    assert current["action"].shape == (5, 1)


def test_a_model_that_explodes_keeps_the_first_actor():
    class Explosive(torch.nn.Module):
        def forward(self, state, action):
            return torch.full_like(state, math.nan)

    trainer = policy_trainer(dynamics=Explosive())
    first = [layer.clone() for layer in trainer.update.actor]
    trainer.advance()
    assert all(layer.isfinite().all() for layer in trainer.update.actor)
    kept = list(trainer.best_actor().parameters())
    assert all(torch.equal(a, b) for a, b in zip(first, kept, strict=True))


def test_the_real_world_has_no_say():
    trainer = policy_trainer(replace(POLICY, real_evaluation_episodes=0), world=WORLD)
    assert "policy/real_return" not in trainer.advance()
    worlds = []
    for friction in (0.5, 5.0):
        world = SimulatedWorld(PENDULUM, SimulatedConfig(friction={"joint": friction}))
        worlds.append(policy_trainer(world=world))
        while not worlds[-1].done:
            metrics = worlds[-1].advance()
        worlds[-1].real_return = metrics["policy/real_return"]
    one, other = worlds
    assert one.real_return != other.real_return
    assert_same_state(one.state_dict(), other.state_dict(), but=["seconds"])


def test_seconds_stop():
    trainer = policy_trainer(replace(POLICY, max_seconds=1e-6))
    assert not trainer.done
    trainer.advance()
    assert trainer.done
    assert trainer.updates == 4
    assert trainer.seconds > 1e-6


def test_the_model_is_not_changed():
    dynamics = HybridDynamics.hybrid(PENDULUM)
    before = copy.deepcopy(dynamics.state_dict())
    trainer = policy_trainer(dynamics=dynamics)
    while not trainer.done:
        trainer.advance()
    assert_same_state(before, dynamics.state_dict())


def test_the_policy_gets_better():
    task = replace(PENDULUM, reward=lambda s, a, n: -(a[..., 0] - 1.0).square())
    rates = replace(POLICY.td3, critic_learning_rate=1e-2, actor_learning_rate=1e-2, gamma=0.5)
    config = replace(
        POLICY, updates=200, batch_size=32, updates_per_step=5, evaluation_interval=50, td3=rates
    )
    trainer = PolicyTrainer(task, SimulatedWorld(task).oracle(), config, seed=0)
    rollouts, states = Rollouts(trainer.world_model, act, max_age=5), task.reset.sample([4])
    untrained = rollouts.returns(trainer.update.actor, states, steps=5).total.mean()
    while not trainer.done:
        trainer.advance()
    assert trainer.best_return > 0.3 * untrained


def test_lives_start_in_real_data():
    states = torch.tensor([[0.5, 3.0], [-0.5, -3.0]])
    config = replace(POLICY, start=StartConfig(reset=0, data=1, coverage=0, goal=0), max_age=1)
    trainer = policy_trainer(config, data_states=states)
    trainer.advance()
    seen = trainer.learner.replay.rows[: len(trainer.learner.replay), :2].unique(dim=0)
    assert torch.equal(seen, states.flip(0))


def test_data_states_must_be_given():
    with pytest.raises(ConfigError, match="data"):
        policy_trainer(replace(POLICY, start=StartConfig(data=0.5)))


def test_lives_begin_at_all_ages():
    trainer = policy_trainer(replace(POLICY, num_worlds=500, max_age=5))
    assert trainer.learner.worlds.age.unique().tolist() == [0, 1, 2, 3, 4]
    assert policy_trainer(replace(POLICY, max_age=None)).max_age == PENDULUM.max_steps


def test_rates_decay_at_the_end(monkeypatch):
    trainer = policy_trainer(replace(POLICY, updates=40, evaluation_interval=40, decay=0.5))
    scales, update = [], type(trainer.update).forward

    def watched(self, batch, scale, generator):
        scales.append(scale)
        return update(self, batch, scale, generator)

    monkeypatch.setattr(type(trainer.update), "forward", watched)
    trainer.advance()
    expected = [1.0] * 11 + [1 - k / 10 for k in range(1, 10)]
    assert scales == pytest.approx(expected)


@pytest.mark.parametrize("limit", [None, 1e-9])
def test_the_critics_are_fitted_at_the_end_also_where_the_seconds_are_spent(limit):
    refit = RefitConfig(transitions=32, horizon=3, steps=2, batch_size=16)
    trainer = policy_trainer(replace(POLICY, refit=refit, max_seconds=limit))
    fitted = []
    while not trainer.done:
        fitted.append("policy/critic_error" in trainer.advance())
    assert fitted == [False] * (len(fitted) - 1) + [True]
    assert len(fitted) == (1 if limit else POLICY.updates // POLICY.evaluation_interval)
    assert trainer.finish() == {}, "it is done"


def test_critics_are_fitted_once_to_each_best_actor():
    refit = RefitConfig(start=4, interval=4, transitions=32, horizon=3, steps=2, batch_size=16)
    trainer = policy_trainer(replace(POLICY, updates=16, refit=refit))
    returns = iter([1.0, 1.0, 0.0, 2.0])
    trainer.evaluation.imagined = lambda actor: Played(torch.full((3,), next(returns)), 1.0)
    fitted, kept = [], []
    while not trainer.done:
        state = copy.deepcopy(trainer.state_dict())
        fitted.append("policy/critic_error" in trainer.advance())
        kept.append([layer.clone() for layer in trainer.best])
        ours = [*trainer.update.networks.actor, *trainer.update.networks.critics]
        assert all(torch.equal(*pair) for pair in zip(ours, trainer.best, strict=True))
    # At the same return as the best, a later actor takes its place.
    assert fitted == [True, True, False, True]
    assert all(torch.equal(*pair) for pair in zip(kept[1], kept[2], strict=True))
    assert state["is_fitted"]
    trainer.load_state_dict(state)
    assert trainer._is_fitted
    del state["is_fitted"]  # a checkpoint from before
    trainer.load_state_dict(state)
    assert not trainer._is_fitted
