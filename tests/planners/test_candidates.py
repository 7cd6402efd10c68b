"""Scores and actions that are not finite never win, and harm nobody."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import pytest
import torch
from points import ZEROS, Point, bounds, half_way, point_problem

from phihp_torchrl.planners import Problem, cem_plan

from .cem_parts import VARIANTS, draw, settings


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("variant", VARIANTS)
def test_scores_that_are_not_finite_never_win(bad, variant):
    def reward(state, action, reward):  # the best actions by far, were they allowed
        return torch.where(action[..., 0] > 0, bad, reward)

    problem = point_problem(lambda observation: -half_way(observation), goal=3.0, reward=reward)
    s = settings(**{**variant, "select": "best"})
    found = cem_plan(ZEROS, draw(s), problem=problem, settings=s)
    assert found.score.isfinite()
    assert (found.actions[:, 0] <= 0).all()
    assert (
        cem_plan(ZEROS, draw(s), problem=problem, settings=replace(s, select="mean")).score > -inf
    )


def bad_problem(actor):
    return point_problem(actor, reward=lambda state, action, reward: reward * nan)


@pytest.mark.parametrize("select", ["mean", "best"])
@pytest.mark.parametrize("compare", [True, False])
@pytest.mark.parametrize("candidates", [0, 1, 10])
def test_an_all_bad_population_leaves_it_to_the_actor(select, compare, candidates):
    s = settings(num_policy_candidates=candidates, select=select, compare_with_actor=compare)
    found = cem_plan(ZEROS, draw(s), problem=bad_problem(half_way), settings=s)
    torch.testing.assert_close(found.actions[0], half_way(ZEROS))
    assert found.score == -inf
    assert found.actions.isfinite().all()


def test_an_all_bad_population_without_actor_leaves_it_to_the_mean():
    s = settings()
    found = cem_plan(ZEROS, draw(s), problem=bad_problem(None), settings=s)
    torch.testing.assert_close(found.actions, bounds().center.expand(4, 2))
    mean = 0.1 * torch.ones(4, 2, dtype=torch.float64)
    found = cem_plan(ZEROS, draw(s), mean, problem=bad_problem(None), settings=s)
    torch.testing.assert_close(found.actions, mean)


def test_a_broken_actor_does_no_harm():
    s = settings(num_policy_candidates=10)
    problem = point_problem(lambda observation: observation * nan)
    found = cem_plan(ZEROS, draw(s), problem=problem, settings=s)
    assert found.score.isfinite()
    assert found.actions.isfinite().all()
    everything_bad = bad_problem(lambda observation: observation * nan)
    found = cem_plan(ZEROS, draw(s), problem=everything_bad, settings=s)
    torch.testing.assert_close(found.actions, bounds().center.expand(4, 2))


def test_bad_elites_do_not_enter_the_mean():
    """Hardly any candidate is good, so most of the elites are bad."""

    def reward(state, action, reward):
        return torch.where(action[..., 0] > 0.8, reward, nan)

    s = settings(planning_horizon=1, top_k=20, optim_steps=1)
    found = cem_plan(ZEROS, draw(s), problem=point_problem(reward=reward), settings=s)
    assert found.score.isfinite()
    assert found.actions[0, 0] > 0.8


def test_a_sequence_that_is_not_finite_never_wins():
    """Not even where the model makes something of it."""

    class Forgiving(Point):
        def transition(self, state, action):
            return super().transition(state, action.nan_to_num(0.3))

    problem = Problem(Forgiving(), bounds(), lambda observation: observation * nan)
    s = settings(planning_horizon=1, num_policy_candidates=20, select="best")
    assert cem_plan(ZEROS, draw(s), problem=problem, settings=s).actions.isfinite().all()


def test_between_two_bad_ones_the_best_candidate_wins():
    """The actor's own action and the mean of the elites are both where nothing is known."""

    def reward(state, action, reward):
        return torch.where(action[..., 0].abs() > 0.5, reward, nan)

    s = settings(
        planning_horizon=1, optim_steps=1, num_candidates=3, top_k=2, num_policy_candidates=1
    )
    noise = torch.tensor([[0.0, 0.0], [0.9, 0.0], [-0.9, 0.0]], dtype=torch.float64)
    problem = point_problem(torch.zeros_like, goal=0.3, reward=reward)
    found = cem_plan(ZEROS, noise.reshape(1, 1, 3, 2), problem=problem, settings=s)
    torch.testing.assert_close(found.actions[0, 0].item(), 0.9)
    assert found.score.isfinite()


def test_one_bad_row_of_a_batch_leaves_the_others_alone():
    def reward(state, action, reward):
        return torch.where(state[..., 0] > 50, nan, reward)

    observation = torch.tensor([[0.0, 0.0], [100.0, 0.0], [0.5, 0.0]], dtype=torch.float64)
    s = settings(num_policy_candidates=4)
    noise, problem = draw(s, (3,)), point_problem(half_way, reward=reward)
    whole = cem_plan(observation, noise, problem=problem, settings=s)
    assert whole.score.isfinite().tolist() == [True, False, True]
    alone = cem_plan(observation[2], noise[:, :, :, 2], problem=problem, settings=s)
    torch.testing.assert_close(whole.actions[2], alone.actions)
