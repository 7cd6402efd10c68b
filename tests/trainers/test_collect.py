"""How phase 1 acts: at random at first, then by planning, always within the bounds."""

from __future__ import annotations

from dataclasses import replace

import pytest

from phihp_torchrl.config import ConfigError
from phihp_torchrl.planners import make_planner
from phihp_torchrl.trainers import ModelConfig, ModelTrainer
from phihp_torchrl.trainers import collect as collect_module

from .trainer_parts import COLLECT, MODEL, PENDULUM, SHORT


def test_the_planner_collects_from_the_second_iteration_on(monkeypatch):
    made = []

    def spy(*args, **kwargs):
        made.append(make_planner(*args, **kwargs))
        return made[-1]

    monkeypatch.setattr(collect_module, "make_planner", spy)
    trainer = ModelTrainer(SHORT, MODEL, seed=0)
    trainer.advance()
    assert made == []
    trainer.advance()
    assert len(made) == 1
    assert made[0].settings.num_candidates == 8
    assert made[0].receding is not None, "a plan is acted on for several steps"


def test_a_collecting_plan_that_cannot_be_is_refused_at_once():
    for change in ({"replan_every": 9}, {"top_k": 9}, {"planning_horizon": 0}):
        with pytest.raises(ConfigError, match=next(iter(change))):
            replace(COLLECT, **{"planning_horizon": 8, "num_candidates": 8, **change})


def push_reward(state, action, next_state):
    return action[..., 0]


@pytest.mark.parametrize("explore", [True, False])
def test_planned_steps_pursue_the_reward(explore):
    rewards = {"exploration_reward": push_reward, "reward": lambda s, a, n: -push_reward(s, a, n)}
    task = replace(PENDULUM, **rewards)
    collect = replace(COLLECT, num_candidates=64, optim_steps=3, noise=0.0)
    collect = replace(collect, exploration_reward=explore)
    config = ModelConfig(real_steps=40, steps_per_iteration=20, kind="oracle", collect=collect)
    trainer = ModelTrainer(task, config, seed=0)
    trainer.advance()
    trainer.advance()
    at_random, planned = trainer.data["action"].split(20)
    assert at_random.mean().abs() < 0.8
    assert (planned.mean() if explore else -planned.mean()) > 1.0


def test_random_actions_are_held_and_bounded():
    config = replace(MODEL, collect=replace(COLLECT, random_hold=5))
    trainer = ModelTrainer(PENDULUM, config, seed=0)
    action = trainer.collect(25)["action"]
    groups = action.reshape(5, 5)
    assert (groups == groups[:, :1]).all()
    assert len(groups.unique()) == 5
    assert (action.abs() <= 2).all()


def test_planned_actions_are_bounded_under_noise():
    config = replace(MODEL, collect=replace(COLLECT, noise=5.0))
    trainer = ModelTrainer(PENDULUM, config, seed=0)
    for _ in range(2):
        trainer.advance()
    planned = trainer.data["action"][25:]
    assert (planned.abs() <= 2).all()
    assert (planned.abs() == 2).float().mean() > 0.5
