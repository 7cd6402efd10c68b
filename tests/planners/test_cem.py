"""A plan by the cross-entropy method: who competes, and what holds of every plan."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from points import ZEROS, bounds, half_way, point_problem

from phihp_torchrl.planners import cem_plan, score_sequences

from .cem_parts import VARIANTS, draw, flat_value, settings, spy_on_scores

# Who competes.


def test_the_actors_own_sequence_is_a_candidate(monkeypatch):
    seen = spy_on_scores(monkeypatch)
    s = settings(num_policy_candidates=5)
    cem_plan(ZEROS, draw(s), problem=point_problem(half_way), settings=s)
    actions = seen[0][0][:, :5]  # [H, N_pi, m]
    state = ZEROS
    for action in actions[:, 0]:
        torch.testing.assert_close(action, half_way(state))
        state = state + action
    noise = (0.05 * draw(s)[0, 0, 1:5]).clamp(-0.3, 0.3) * bounds().scale
    torch.testing.assert_close(actions[0, 1:], half_way(ZEROS) + noise)


def test_policy_noise_is_clipped_in_units_of_the_half_range(monkeypatch):
    seen = spy_on_scores(monkeypatch)
    s = settings(num_policy_candidates=40, policy_noise=10.0, policy_noise_clip=0.1, optim_steps=1)
    cem_plan(ZEROS, draw(s), problem=point_problem(torch.zeros_like), settings=s)
    largest = seen[0][0].abs().amax((0, 1))
    torch.testing.assert_close(largest, 0.1 * bounds().scale)


def test_the_mean_is_the_first_random_candidate(monkeypatch):
    seen = spy_on_scores(monkeypatch)
    s = settings(num_policy_candidates=3)
    mean = 0.2 * torch.ones(4, 2, dtype=torch.float64)
    cem_plan(ZEROS, draw(s), mean, problem=point_problem(half_way), settings=s)
    torch.testing.assert_close(seen[0][0][:, 3], mean)


def test_the_actors_own_sequence_competes_once(monkeypatch):
    """Were the best of all counted twice, two elites would be one and the spread would vanish."""
    seen = spy_on_scores(monkeypatch)
    s = settings(
        planning_horizon=1, top_k=2, num_policy_candidates=1, num_kept_elites=1, num_candidates=20
    )
    perfect = point_problem(lambda observation: 0.3 - observation)
    cem_plan(ZEROS, draw(s), problem=perfect, settings=s)
    third_iteration = seen[2][0]
    assert third_iteration.std(1).min() > 1e-6


def test_min_std_keeps_later_iterations_apart(monkeypatch):
    seen = spy_on_scores(monkeypatch)
    for floor in (0.0, 0.5):
        s = settings(top_k=1, min_std=floor, optim_steps=2)
        cem_plan(ZEROS, draw(s), problem=point_problem(), settings=s)
    spread = [actions.std(1).max() for actions, _ in seen]
    assert spread[1] < 1e-9
    assert spread[3] > 0.2


# What holds of every plan.


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("seed", range(3))
def test_plans_stay_in_bounds(variant, seed):
    s = settings(**variant)
    problem = point_problem(lambda observation: 10 * torch.ones_like(observation), goal=5.0)
    actions = cem_plan(ZEROS, 3 * draw(s, seed=seed), problem=problem, settings=s).actions
    assert actions.shape == (4, 2)
    assert (actions >= problem.bounds.low).all()
    assert (actions <= problem.bounds.high).all()


def test_more_budget_is_no_worse_on_a_quadratic():
    observation = torch.linspace(-2, 2, 64, dtype=torch.float64).reshape(32, 2)
    problem = point_problem()

    def value_of(**kwargs):
        s = settings(**kwargs)
        actions = cem_plan(observation, draw(s, (32,)), problem=problem, settings=s).actions
        scores, _ = score_sequences(
            observation, actions.transpose(0, 1), problem, gamma=s.gamma, alpha=s.alpha
        )
        return scores.mean().item()

    by_iterations = [value_of(optim_steps=i) for i in (1, 2, 4, 8)]
    assert by_iterations == sorted(by_iterations)
    by_candidates = [value_of(num_candidates=n) for n in (10, 40, 160, 640)]
    assert by_candidates == sorted(by_candidates)


@pytest.mark.parametrize("variant", VARIANTS)
def test_further_iterations_never_lose_the_best(variant):
    s = settings(**{**variant, "select": "best", "optim_steps": 6})
    noise, problem = draw(s), point_problem(half_way, flat_value)
    scores = [
        cem_plan(ZEROS, noise[:i], problem=problem, settings=replace(s, optim_steps=i)).score.item()
        for i in range(1, 7)
    ]
    assert scores == sorted(scores)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("seed", range(3))
def test_never_beaten_by_its_own_candidates(variant, seed, monkeypatch):
    seen = spy_on_scores(monkeypatch)
    s = settings(**{**variant, "select": "best"})
    problem = point_problem(half_way, flat_value)
    found = cem_plan(ZEROS, draw(s, seed=seed), problem=problem, settings=s)
    assert found.score == max(scores.max() for _, scores in seen)
    scores, _ = score_sequences(
        ZEROS[None], found.actions[:, None], problem, gamma=s.gamma, alpha=s.alpha
    )
    torch.testing.assert_close(scores[0], found.score)


@pytest.mark.parametrize("select", ["mean", "best"])
def test_never_beaten_by_its_own_actor(select, monkeypatch):
    """An actor that is hard to beat, with a budget that hardly suffices."""
    seen = spy_on_scores(monkeypatch)
    s = settings(num_policy_candidates=1, num_candidates=8, top_k=4, optim_steps=1, select=select)
    wins = 0
    for seed in range(20):
        del seen[:]
        found = cem_plan(ZEROS, draw(s, seed=seed), problem=point_problem(half_way), settings=s)
        own_actions, own_score = seen[0][0][:, 0], seen[0][1][0]
        assert found.score >= own_score
        wins += int(torch.equal(found.actions, own_actions))
    assert wins > 0  # else this test is too easy


def test_a_margin_keeps_the_actor():
    problem = point_problem(torch.zeros_like)
    s = settings(num_policy_candidates=4)
    moved = cem_plan(ZEROS, draw(s), problem=problem, settings=s).actions
    kept = cem_plan(ZEROS, draw(s), problem=problem, settings=replace(s, actor_margin=1e3)).actions
    assert moved.abs().max() > 0.1
    assert torch.equal(kept, torch.zeros_like(kept))


def test_a_margin_at_rest_keeps_only_an_actor_that_rests():
    s = settings(num_policy_candidates=4, actor_margin=1e3, margin_at_rest=True)
    resting = cem_plan(ZEROS, draw(s), problem=point_problem(torch.zeros_like), settings=s)
    assert torch.equal(resting.actions, torch.zeros_like(resting.actions))
    moving = point_problem(half_way)  # whose steps are half as long each time
    free = cem_plan(ZEROS, draw(s), problem=moving, settings=replace(s, actor_margin=0.0))
    found = cem_plan(ZEROS, draw(s), problem=moving, settings=s)
    kept = cem_plan(ZEROS, draw(s), problem=moving, settings=replace(s, margin_at_rest=False))
    assert torch.equal(found.actions, free.actions)
    assert not torch.equal(found.actions, kept.actions)


@pytest.mark.parametrize("variant", VARIANTS)
def test_splitting_a_batch_changes_nothing(variant):
    s = settings(**variant)
    problem = point_problem(half_way, flat_value, wall=1.4)
    observation = torch.randn(2, 3, 2, dtype=torch.float64)
    noise = draw(s, (2, 3))
    whole = cem_plan(observation, noise, problem=problem, settings=s)
    assert whole.actions.shape == (2, 3, 4, 2)
    assert whole.score.shape == (2, 3)
    for i in range(2):
        row = cem_plan(observation[i], noise[:, :, :, i], problem=problem, settings=s)
        torch.testing.assert_close(row.actions, whole.actions[i])
        for j in range(3):
            single = cem_plan(observation[i, j], noise[:, :, :, i, j], problem=problem, settings=s)
            torch.testing.assert_close(single.actions, whole.actions[i, j])
            torch.testing.assert_close(single.score, whole.score[i, j])


def test_horizon_one():
    s = settings(planning_horizon=1, num_policy_candidates=5, optim_steps=6)
    problem = point_problem(torch.zeros_like, lambda observation, action: observation[:, 0] * 0.0)
    found = cem_plan(ZEROS, draw(s), problem=problem, settings=s)
    assert found.actions.shape == (1, 2)
    torch.testing.assert_close(
        found.actions, torch.full_like(found.actions, 0.3), atol=0.02, rtol=0
    )
