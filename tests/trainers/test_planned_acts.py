"""Plans that act in some of the imagined worlds: where, by which model, and that they help."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch

from phihp_torchrl import HybridDynamics
from phihp_torchrl.agents import act
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.trainers import PolicyConfig
from phihp_torchrl.trainers.planned_acts import PlannedActs
from phihp_torchrl.trainers.strategies import STRATEGIES

from .trainer_parts import PENDULUM, POLICY, assert_same_state, policy_trainer

ALONE, PLANNED = replace(POLICY, planned=0.0), replace(POLICY, planned=0.75)
SEARCH = CEMConfig(planning_horizon=8, num_candidates=32, alpha=0.0)


def policy_of(trainer, worlds, search=SEARCH):
    generator = torch.Generator().manual_seed(0)
    model, networks = trainer.world_model, trainer.update.networks
    return PlannedActs(model, networks, search, worlds=worlds, generator=generator)


def test_plans_act_in_the_first_worlds_and_the_actor_in_the_others():
    trainer = policy_trainer()
    observation = PENDULUM.observe(PENDULUM.coverage.sample([5]))
    weights, bounds = trainer.update.actor, PENDULUM.bounds
    found = policy_of(trainer, 2)(weights, observation, bounds)
    own = act(weights, observation, bounds)
    assert torch.equal(found[2:], own[2:])
    assert (found[:2] != own[:2]).all()
    assert (found.abs() <= bounds.scale).all()


def test_plans_earn_more_in_the_model_than_an_actor_that_has_learned_nothing():
    trainer = policy_trainer()
    model, rewards = trainer.world_model, []
    for worlds in (0, 16):
        policy = policy_of(trainer, worlds)
        state, total = PENDULUM.coverage.sample([16]) * 0.0 + torch.tensor([1.0, 0.0]), 0.0
        for _ in range(10):
            action = policy(trainer.update.actor, model.observe(state), PENDULUM.bounds)
            state, reward, _ = model.transition(state, action)
            total += reward.mean().item()
        rewards.append(total)
    assert rewards[1] > rewards[0] + 1.0


def test_values_of_the_present_critics_count():
    trainer = policy_trainer()
    observation = PENDULUM.observe(torch.zeros(2, 2))
    policy = policy_of(trainer, 2, replace(SEARCH, alpha=1.0))
    before = policy(trainer.update.actor, observation, PENDULUM.bounds)
    with torch.no_grad():
        for layer in trainer.update.networks.critics:
            layer.mul_(3.0)
    policy.generator.manual_seed(0)
    assert not torch.equal(policy(trainer.update.actor, observation, PENDULUM.bounds), before)


def test_warm_worlds_alone_are_planned(monkeypatch):
    calls = []
    monkeypatch.setattr(
        PlannedActs, "__call__", lambda self, w, o, b: (calls.append(len(o)), act(w, o, b))[1]
    )
    trainer = policy_trainer(PLANNED)
    trainer.advance()
    warm = trainer.learner.imagined_steps - POLICY.random_steps
    assert len(calls) * POLICY.num_worlds == warm > 0
    trainer.advance()
    calls.clear()
    trainer.advance()
    assert not calls, "plans have given way to the actor"
    policy_trainer(ALONE).advance()
    assert not calls


def test_plans_go_by_the_mean_where_every_life_has_a_model_of_its_own():
    dynamics = HybridDynamics.hybrid(PENDULUM, ensemble=2)
    trainer = policy_trainer(PLANNED, dynamics=dynamics)
    acts = trainer.learner.planned.policy
    state, action = torch.ones(3, 2), torch.zeros(3, 1)
    expected = TaskWorldModel(PENDULUM, dynamics).transition(state, action)[0]
    torch.testing.assert_close(acts.world_model.transition(state, action)[0], expected)
    assert trainer.world_model.transitions is not dynamics
    trainer.advance()


def test_a_resumed_run_with_plans_is_the_same_run():
    whole, first = policy_trainer(PLANNED), policy_trainer(PLANNED)
    dynamics = first.world_model.transitions
    whole.advance()
    first.advance()
    resumed = policy_trainer(PLANNED, seed=7, dynamics=copy.deepcopy(dynamics))
    resumed.load_state_dict(copy.deepcopy(first.state_dict()))
    while not whole.done:
        whole.advance()
        resumed.advance()
    assert_same_state(whole.state_dict(), resumed.state_dict(), but=["seconds"])


def test_more_worlds_of_a_strategy_have_no_more_plans():
    config = PolicyConfig()
    changed = STRATEGIES["goal"].change(config, PENDULUM)
    assert changed.planned * changed.num_worlds == config.planned * config.num_worlds == 16


def test_errors_name_the_key():
    with pytest.raises(ConfigError, match=r"^planned: "):
        PolicyConfig(planned=1.5)
