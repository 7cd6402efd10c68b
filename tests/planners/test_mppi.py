"""A plan by path integral control, by hand and by property."""

from __future__ import annotations

from dataclasses import replace
from math import exp, inf, nan, sqrt

import pytest
import torch
from points import ZEROS, bounds, half_way, point_problem

from phihp_torchrl.planners import MPPIConfig, MPPINoise
from phihp_torchrl.planners.mppi import elite_weights

from .mppi_parts import draw, plan, settings

# By hand.


def test_elite_weights_by_hand():
    """Temperature 0.5 and scores 2 apart: 1, 1/e, normalised; a bad score has no weight."""
    weights = elite_weights(torch.tensor([[3.0], [1.0], [-inf]]), 0.5)
    expected = torch.tensor([1.0, exp(-1.0), 0.0]) / (1 + exp(-1.0))
    torch.testing.assert_close(weights[:, 0], expected)
    assert elite_weights(torch.full((4, 1), -inf), 0.5).tolist() == [[0.25]] * 4
    assert elite_weights(torch.tensor([[3.0], [1.0]]), 0.0).tolist() == [[0.5], [0.5]]


def one_step(momentum=0.0, min_std=0.0, select="mean", choice=((0.5,), (0.5,)), mean=0.0):
    """Candidates 0.3, -0.1 and 0.9 around ``mean``, of which the first two are the elites."""
    s = settings(
        planning_horizon=1,
        optim_steps=1,
        num_candidates=3,
        top_k=2,
        momentum=momentum,
        min_std=min_std,
        temperature=2.0,
        select=select,
    )
    choice = torch.tensor(choice, dtype=torch.float64)
    rows = choice.shape[1]
    samples = torch.tensor([0.3, -0.1, 0.9], dtype=torch.float64).reshape(1, 1, 3, 1, 1)
    samples = samples.expand(-1, -1, -1, rows, -1)
    noise = MPPINoise(samples, samples[0, :, :0], choice)
    state = torch.zeros(rows, 1, dtype=torch.float64)
    mean = torch.full((rows, 1, 1), mean, dtype=torch.float64)
    return plan(state, noise, s, mean, limits=bounds((-1.0,), (1.0,)))


# Goal 0.3: the scores are 0 and -0.16, so the weights 1 and e^(-0.32), normalised.
W = 1 / (1 + exp(-0.32))
MEAN = 0.3 * W - 0.1 * (1 - W)
STD = sqrt(W * (0.3 - MEAN) ** 2 + (1 - W) * (-0.1 - MEAN) ** 2)


def test_refit_by_hand():
    found = one_step()
    torch.testing.assert_close(found.mean.item(), MEAN)
    torch.testing.assert_close(found.std.item(), STD)
    assert found.actions.item() == found.mean.item()
    assert found.score.item() == 0.0


def test_momentum_and_the_limits_of_the_std_by_hand():
    found = one_step(momentum=0.25, min_std=0.5)
    torch.testing.assert_close(found.mean.item(), 0.75 * MEAN)
    assert found.std.item() == 0.5
    # Around 0.2 the three candidates are 0.5, 0.1 and 1 (clipped): 0.5 and 0.1 score the same.
    shifted = one_step(mean=0.2, momentum=0.5)
    torch.testing.assert_close(shifted.mean.item(), 0.5 * 0.2 + 0.5 * 0.3)


def test_the_elite_to_act_with_is_drawn_by_its_weight():
    draws = torch.rand(2, 4000, generator=torch.Generator().manual_seed(0))
    actions = one_step(select="sample", choice=draws.tolist()).actions.flatten().tolist()
    share = sum(action == 0.3 for action in actions) / len(actions)
    assert set(actions) == {0.3, -0.1}
    assert abs(share - W) < 4 * sqrt(W * (1 - W) / len(actions))


# By property.


def test_more_budget_is_no_worse_on_a_quadratic():
    state = torch.randn(50, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def score(**kwargs):
        s = settings(**kwargs)
        actions = plan(state, draw(s, (50,)), s).actions
        p, total, now = point_problem(), 0.0, state
        for k in range(4):
            now, reward, _ = p.model.transition(now, actions[:, k])
            total = total + 0.99**k * reward
        return total.mean().item()

    small, more_steps = score(optim_steps=1), score(optim_steps=6)
    more_candidates = score(optim_steps=1, num_candidates=600)
    both = score(optim_steps=6, num_candidates=600)
    assert small < more_steps <= both + 1e-3
    assert small < more_candidates <= both + 1e-3


@pytest.mark.parametrize("select", ["sample", "mean"])
@pytest.mark.parametrize("guided", [0, 10])
def test_plans_stay_in_bounds(select, guided):
    s = settings(num_policy_candidates=guided, init_std=2.0, select=select, policy_noise=5.0)
    far = torch.full((7, 2), 50.0, dtype=torch.float64)
    found = plan(far, draw(s, (7,)), s, actor=half_way, goal=-99.0)
    low, high = torch.tensor([-1.0, -0.5]), torch.tensor([1.0, 0.75])
    assert ((found.actions >= low) & (found.actions <= high)).all()
    assert (found.std > 0).all()


def test_the_order_of_candidates_changes_nothing():
    s = settings(num_policy_candidates=10)
    noise = draw(s, (3,))
    order = torch.randperm(50, generator=torch.Generator().manual_seed(5))
    other = noise._replace(samples=noise.samples[:, :, order])
    state = torch.zeros(3, 2, dtype=torch.float64)
    plans = [plan(state, n, s, actor=half_way) for n in (noise, other)]
    torch.testing.assert_close(*(p.mean for p in plans))
    torch.testing.assert_close(*(p.std for p in plans))


@pytest.mark.parametrize("guided", [0, 10])
def test_splitting_a_batch_changes_nothing(guided):
    s = settings(num_policy_candidates=guided, select="sample")
    noise = draw(s, (2, 3))
    state = torch.randn(2, 3, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    mean = torch.full((2, 3, 4, 2), 0.1, dtype=torch.float64)
    whole = plan(state, noise, s, mean, actor=half_way)
    assert whole.actions.shape == (2, 3, 4, 2)
    for i in range(2):
        for j in range(3):
            own = MPPINoise(
                noise.samples[:, :, :, i, j], noise.policy[:, :, i, j], noise.choice[:, i, j]
            )
            single = plan(state[i, j], own, s, mean[i, j], actor=half_way)
            for one, all_of_them in zip(single, whole, strict=True):
                torch.testing.assert_close(one, all_of_them[i, j])


def test_the_actors_sequences_compete():
    """A good actor and candidates that hardly move: what wins is the actor's."""
    s = settings(num_policy_candidates=10, init_std=0.01, min_std=0.001, policy_noise=0.01)
    start = torch.full((2,), 0.9, dtype=torch.float64)
    with_actor = plan(start, draw(s), s, actor=half_way)
    without = plan(
        start, draw(s), replace(s, num_policy_candidates=0, num_candidates=50), actor=None
    )
    assert with_actor.score > without.score + 0.5
    torch.testing.assert_close(with_actor.mean[0], half_way(start), atol=0.05, rtol=0)


def test_nothing_counts_after_a_termination():
    """Beyond the wall rewards are enormous, but the episode is over there."""

    def reward(state, action, reward):
        return torch.where((state.abs() > 0.5).any(-1), 1e6, reward)

    s = settings()
    assert plan(ZEROS, draw(s), s, wall=0.5, reward=reward).score < 0
    assert plan(ZEROS, draw(s), s, reward=reward).score > 1e5


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_scores_that_are_not_finite_never_win(bad):
    def reward(state, action, reward):
        return torch.where(action[..., 0] > 0, bad, reward)

    s = settings(select="sample")
    found = plan(ZEROS, draw(s), s, reward=reward)
    assert found.score.isfinite()
    assert (found.actions[:, 0] <= 0).all()
    nothing = plan(ZEROS, draw(s), s, actor=half_way, reward=lambda *_: torch.tensor(bad))
    torch.testing.assert_close(nothing.actions[0], half_way(ZEROS))
    assert nothing.score == -inf


# Bad settings.


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("temperature", -1.0),
        ("momentum", 1.0),
        ("select", "best"),
        ("min_std", 3.0),
        ("num_policy_candidates", 60),
        ("top_k", 61),
        ("gamma", 1.5),
    ],
)
def test_settings_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        settings(**{name: value})


def test_as_many_candidates_of_the_actor_as_there_are_leave_none_to_refit():
    with pytest.raises(ValueError, match=r"^num_policy_candidates: expected fewer than"):
        MPPIConfig(num_candidates=20, num_policy_candidates=20, top_k=4)
