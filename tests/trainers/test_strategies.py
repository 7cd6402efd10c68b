"""What the policy phase tries where imagined returns stay at the floor."""

from __future__ import annotations

import itertools
import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from phihp_torchrl import Box, HybridDynamics, System, get_task, make_world
from phihp_torchrl.agents import RefitConfig, TD3Config
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Rollouts
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers import PolicyConfig, PolicySearch, PolicyTrainer, RunConfig
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.floor import Floor
from phihp_torchrl.trainers.policy_evaluation import ActorEvaluation
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.strategies import STRATEGIES, strategies_of

TINY = PolicyConfig(
    updates=8,
    batch_size=8,
    evaluation_interval=2,
    evaluation_episodes=8,
    random_steps=64,
    patience=0.0,
    td3=TD3Config(actor_hidden_sizes=(8,), critic_hidden_sizes=(8,)),
    refit=RefitConfig(interval=0),
)


def sparse(reward: Any) -> Task:
    return replace(get_task("pendulum"), max_steps=5, reward=reward)


def never(state: torch.Tensor, action: torch.Tensor, next_state: torch.Tensor) -> torch.Tensor:
    return torch.zeros_like(next_state[..., 0])


def search(task: Task, config: PolicyConfig = TINY) -> PolicySearch:
    torch.manual_seed(0)
    model = HybridDynamics.hybrid(task)
    return PolicySearch(
        task, config, lambda settings: PolicyTrainer(task, model, settings, seed=0), seed=0
    )


def run(phase: PolicySearch) -> list[dict[str, float]]:
    rows = []
    while not phase.done:
        rows.append(phase.advance())
    return rows


def test_a_reward_that_is_never_met_is_said_and_every_strategy_tried(
    caplog: pytest.LogCaptureFixture,
) -> None:
    phase = search(sparse(never))
    rows = run(phase)
    assert [row["policy/strategy"] for row in rows] == [
        0,
        0,
        1,
        1,
        2,
        2,
        3,
        3,
        4,
        4,
    ]  # left half-way
    assert [row["policy/updates"] for row in rows] == [*range(2, 22, 2)]
    assert [row["policy/at_floor"] for row in rows if "policy/at_floor" in row] == [1] * 5
    assert phase.progress == (20, 24)
    tried = ["as-set", "goal", "analytic", "further", "wide"]  # backwards needs a goal box
    assert phase.summary["tried"] == tried
    assert phase.summary["at_floor"]
    warnings = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert len(warnings) == 5
    assert "Trying strategy 'goal'" in warnings[0]
    assert "Check that the reward can be reached" in warnings[4]


def test_an_actor_above_the_floor_ends_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    shares = iter([1.0, 1.0, 0.2, 0.1])  # half-way of episodes and of lives; both ends
    monkeypatch.setattr(Floor, "share", lambda self, returns: next(shares))
    phase = search(sparse(never), replace(TINY, td3=replace(TINY.td3, gamma=0.5)))
    rows = run(phase)
    assert [row["policy/strategy"] for row in rows] == [0, 0, 1, 1, 1, 1]
    assert phase.summary == {"tried": ["as-set", "goal"], "kept": "goal", "at_floor": False}
    assert phase.planner_changes == {"gamma": math.exp(-0.5)}


def test_the_search_goes_on_while_the_actor_that_earns_most_is_at_the_floor(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    shares = iter([1.0, 1.0, 0.2, 0.1, 0.2, 0.1])
    monkeypatch.setattr(Floor, "share", lambda self, returns: next(shares))
    earned = [5.0, 1.0, 7.0]
    monkeypatch.setattr(
        PolicySearch, "_returns", lambda self, *_: torch.full((8,), earned[self.tried])
    )
    phase = search(sparse(never))
    run(phase)
    tried = ["as-set", "goal", "analytic"]
    assert phase.summary == {"tried": tried, "kept": "analytic", "at_floor": False}
    assert "Strategy 'goal' earns less after 8 updates than one" in caplog.text


def test_the_best_return_at_the_end_is_that_of_the_actor_that_is_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    falling = itertools.count(-1.0, -1.0)
    monkeypatch.setattr(ActorEvaluation, "mean", lambda self, returns: next(falling))
    monkeypatch.setattr(
        PolicySearch, "_returns", lambda self, *_: torch.full((8,), -float(self.tried))
    )
    monkeypatch.setattr(Floor, "share", lambda self, returns: 1.0)
    phase = search(sparse(never))
    best = [row["policy/best_imagined_return"] for row in run(phase)]
    assert phase.summary["kept"] == "as-set"
    assert best[:2] == [-1.0, -1.0]
    assert best[-2] < best[-1] == -1.0
    resumed = search(sparse(never))
    resumed.load_state_dict(phase.state_dict())
    assert resumed._kept().imagined == -1.0


def test_skill_near_the_goal_is_given_time_to_spread(monkeypatch: pytest.MonkeyPatch) -> None:
    shares = iter([1.0, 0.8, 0.1])
    monkeypatch.setattr(Floor, "share", lambda self, returns: next(shares))
    phase = search(sparse(never))
    assert [row["policy/strategy"] for row in run(phase)] == [0, 0, 0, 0]
    assert phase.summary == {"tried": ["as-set"], "kept": "as-set", "at_floor": False}


def test_none_of_it_changes_what_is_learned_where_nothing_is_stuck(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task = replace(get_task("pendulum"), max_steps=5)
    torch.manual_seed(0)
    alone = PolicyTrainer(task, HybridDynamics.hybrid(task), TINY, seed=0)
    while not alone.done:
        alone.advance()
    phase = search(task, replace(TINY, strategies=("wide",)))
    monkeypatch.setattr(Floor, "share", lambda self, returns: 0.0)
    run(phase)
    ours, theirs = phase.best_actor().state_dict(), alone.best_actor().state_dict()
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)


def test_a_stopped_search_goes_on_where_it_was() -> None:
    whole = search(sparse(never))
    expected = run(whole)
    first = search(sparse(never))
    for _ in range(3):
        first.advance()
    state, random = first.state_dict(), torch.get_rng_state()
    again = search(sparse(never))
    again.load_state_dict(state)
    torch.set_rng_state(random)
    rows = run(again)
    keys = ("policy/strategy", "policy/updates", "policy/loss_qvalue")
    for row, other in zip(rows, expected[3:], strict=True):
        assert [row.get(key) for key in keys] == [other.get(key) for key in keys]
    ours, theirs = again.best_actor().state_dict(), whole.best_actor().state_dict()
    assert all(torch.equal(ours[key], theirs[key]) for key in theirs)


def test_random_actions_that_run_away_hide_no_skill() -> None:
    def reward(state, action, next_state):
        return -(next_state**2).sum(-1) - 1e4 * (action**2).sum(-1)

    task = replace(get_task("pendulum"), max_steps=5, reward=reward)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    floor = Floor(model, task.reset.sample([10]), 5, seed=0)
    assert floor.share(floor.returns + 1.0) == 0.0


def test_few_good_starts_do_not_hide_that_most_are_at_the_floor() -> None:
    task = replace(get_task("pendulum"), max_steps=5)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    floor = Floor(model, task.reset.sample([10]), 5, seed=0)
    returns = floor.returns.clone()
    returns[:2] += 1000.0
    assert floor.share(returns) == 0.8
    assert floor.share(floor.returns + 1000.0) == 0.0
    assert floor.share(floor.returns - 1000.0) == 1.0
    assert floor.share(torch.full((10,), float("nan"))) == 1.0


def goal_alone(state, action, next_state):
    return 2.0 * (next_state[..., 0].abs() < 0.1).float()


@pytest.mark.parametrize(("ends", "wide", "passed"), [(False, 4096, 1.0), (True, 4096, 0.0),
                                                      (False, 0, 0.0)])  # fmt: skip
def test_who_passes_the_goal_from_starts_that_are_alike_is_at_the_floor(ends, wide, passed) -> None:
    hanging = Box.around((3.1, 0.0), (0.01, 0.01))
    ended = (lambda state: state[..., 0].abs() < 0.1) if ends else None
    task = replace(get_task("pendulum"), reset=hanging, reward=goal_alone, terminated=ended)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    anywhere = task.coverage.sample([wide]) if wide else None
    floor = Floor(model, task.reset.sample([10]), 100, seed=0, wide=anywhere)
    assert floor.share(torch.full((10,), 6.0)) == passed, "three steps of a hundred"
    assert floor.share(torch.full((10,), 0.0)) == 1.0
    assert floor.share(torch.full((10,), 25.0)) == 0.0


@pytest.mark.parametrize("extension", [0.0, 0.3, 1.0])
def test_starts_where_the_reward_is_met_are_many_and_critics_wait_for_the_end(extension) -> None:
    config = PolicyConfig(updates=4400, extension=extension)
    for name, kind in (("pendulum", "rewarding"), ("cartpole-swingup", "goal")):
        changed = STRATEGIES["goal"].change(config, get_task(name))
        assert changed.num_worlds == 4 * config.num_worlds
        assert (getattr(changed.start, kind), changed.start.reset) == (0.6, 0.2)
        end = 4400 * (1 + extension)
        assert not any(changed.refit.is_due(k, int(end)) for k in range(500, int(end), 500))
        assert changed.refit.is_due(int(end), int(end))
    assert STRATEGIES["goal"].change(config, replace(get_task("pendulum"), coverage=None)) is config


def test_strategies_keep_what_reaches_further_already() -> None:
    td3 = replace(TINY.td3, gamma=0.999, value_expansion=9, saturation_cost=0.2)
    far = replace(TINY, td3=td3, max_age=7)
    task = get_task("pendulum")
    changed = STRATEGIES["further"].change(far, task)
    assert changed == far  # so that it is not tried at all
    assert "further" not in dict(search(sparse(never), far).ways)


def test_starts_go_backwards_from_the_goal_to_the_coverage() -> None:
    task = replace(get_task("cartpole-swingup"), max_steps=5)
    config = STRATEGIES["backwards"].change(TINY, task)
    trainer = PolicyTrainer(task, HybridDynamics.hybrid(task), config, seed=0)
    widths = []
    while not trainer.done:
        trainer.advance()
        box = trainer.start_states.samplers[-1].physical.box
        widths.append(box.high[2] - box.low[2])
    goal, coverage = task.goal, task.coverage
    assert widths == sorted(widths)
    assert widths[0] == pytest.approx(goal.high[2] - goal.low[2])
    assert widths[-1] == pytest.approx(coverage.high[2] - coverage.low[2])
    assert STRATEGIES["backwards"].change(TINY, sparse(never)) is TINY  # it has no goal box


def test_gradients_are_tried_where_the_model_is_smooth() -> None:
    task = get_task("cartpole-swingup")
    config = STRATEGIES["analytic"].change(TINY, task)
    assert (config.method, config.analytic.critic_updates) == ("analytic", 2)  # every 2 evaluated
    walled = replace(task, position_limits={"x": (-3.0, 3.0)})
    assert STRATEGIES["analytic"].change(TINY, walled) is TINY


@pytest.mark.parametrize("strategies", ["always", ("further", "sideways")])
def test_unknown_strategies_are_refused(strategies: Any) -> None:
    with pytest.raises(ConfigError, match="strategies: expected"):
        strategies_of(replace(TINY, strategies=strategies))


class Slider(System):
    state_names, action_names = ("x", "x_dot"), ("force",)
    velocity_of = {"x": "x_dot"}

    def prior(self, state, action, constants):
        return torch.stack([state[..., 1], action[..., 0]], -1)


@torch.no_grad()
def test_starts_that_leave_nothing_to_gain_hide_no_skill() -> None:
    task = Task(
        name="slider",
        system=Slider(),
        action_high=(1.0,),
        time_step=0.05,
        max_steps=200,
        reset=Box.around((0.0, 0.0), (1.0, 0.1)),
        reward=lambda state, action, next_state: -next_state.square().sum(-1),
    )
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    states = task.reset.sample([64], generator=torch.Generator().manual_seed(0))
    wide = task.reset.sample([4096], generator=torch.Generator().manual_seed(1))
    floor = Floor(model, states, 200, seed=0, wide=wide)
    regulator, idle = (
        Rollouts(model, policy, 200).returns([], states, 200).total
        for policy in (
            lambda weights, observed, bounds: bounds.clip(-observed.sum(-1, keepdim=True)),
            lambda weights, observed, bounds: torch.zeros_like(observed[:, :1]),
        )
    )
    assert floor.share(regulator) < 0.15
    assert floor.share(idle) == 1.0


@pytest.mark.parametrize(("gamma", "planned"), [(0.99, 0.9), (0.8, 0.8)])
def test_the_planner_discounts_as_its_critics_do_unless_it_is_told_otherwise(
    tmp_path: Path, gamma: float, planned: float
) -> None:
    phase = search(sparse(never), replace(TINY, td3=replace(TINY.td3, gamma=0.9)))
    config, world = RunConfig("pendulum", planner=CEMConfig(gamma=gamma)), make_world("pendulum")
    settings, before = config.section("policy"), {"policy": phase}
    context = Context(config, settings, world.task, world, before, RunDirectory(tmp_path))
    assert context.planner is not None
    assert context.planner.gamma == planned
