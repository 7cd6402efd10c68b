"""What makes plans smooth: noise of a colour, the price of a change, and the plan that stands."""

from __future__ import annotations

import pytest
import torch
from points import ZEROS, half_way, point_problem
from tensordict import TensorDict

from phihp_torchrl.config import ConfigError
from phihp_torchrl.planners import CEMConfig, MPPIConfig, cem_plan, colored, score_sequences

from . import mppi_parts
from .cem_parts import draw, settings, spy_on_scores
from .planner_parts import make_planner, noise_for, task_parts

# Noise.


@pytest.mark.parametrize("beta", [0.5, 1.0, 2.0, 3.0])
def test_colored_noise_keeps_its_spread_and_moves_less(beta):
    white = torch.randn(2, 12, 20_000, generator=torch.Generator().manual_seed(0))
    noise = colored(white, beta, dim=1)
    assert noise.shape == white.shape
    torch.testing.assert_close(noise.std((0, 2)), torch.ones(12), atol=0.03, rtol=0)
    assert noise.diff(dim=1).std() < 0.9 * white.diff(dim=1).std()


def test_more_beta_is_smoother_and_none_is_white():
    white = torch.randn(10, 5_000, generator=torch.Generator().manual_seed(1))
    steps = [colored(white, beta, dim=0).diff(dim=0).std() for beta in (0.0, 1.0, 2.0, 4.0)]
    assert steps == sorted(steps, reverse=True)
    assert colored(white, 0.0, dim=0) is white


def test_colored_noise_has_the_power_law_it_is_named_for():
    """Of long sequences, in a band away from both ends."""
    white = torch.randn(512, 2_000, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    window = torch.hann_window(512, dtype=torch.float64)[:, None]
    power = torch.fft.rfft(window * colored(white, 2.0, dim=0), dim=0).abs().square().mean(1)
    assert 3.5 < power[20] / power[40] < 4.5  # half of the frequency, 2² of the power


def test_the_planner_colors_the_noise_that_it_is_given(monkeypatch):
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env, noise_beta=2.0)
    given = []
    monkeypatch.setattr(planner, "_call_plan", lambda tensordict, noise, *rest: given.append(noise))
    noise = noise_for(planner)
    planner.plan(TensorDict(observation=torch.tensor([1.0, 0.0, 0.0])), noise)
    torch.testing.assert_close(given[0], colored(noise, 2.0, dim=1))


# The price of a change.


def test_a_change_is_priced_in_units_of_the_half_range():
    problem = point_problem(reward=lambda state, action, reward: 0 * reward)
    actions = problem.bounds.from_unit(
        torch.tensor([[[0.5, 0.0]], [[0.0, 1.0]], [[0.0, 1.0]]], dtype=torch.float64)
    )
    options = {"gamma": 0.5, "alpha": 0.0, "change_cost": 2.0}
    known, unknown = problem.bounds.center[None], torch.full((1, 2), torch.nan)
    first, second = 0.25, 0.25 + 1.0
    for last, expected in ((known, first + 0.5 * second), (unknown, 0.5 * second)):
        scores, _ = score_sequences(ZEROS[None], actions, problem, last=last, **options)
        torch.testing.assert_close(scores, -2.0 * torch.tensor([expected], dtype=torch.float64))
    without, _ = score_sequences(ZEROS[None], actions, problem, **options)
    torch.testing.assert_close(without, scores)


@pytest.mark.parametrize("kind", ["cem", "mppi"])
def test_a_price_keeps_a_plan_near_the_last_action(kind):
    last = torch.tensor([-0.5, 0.5], dtype=torch.float64)

    def first_action(price):
        if kind == "mppi":
            s = mppi_parts.settings(change_cost=price)
            noise, floor = mppi_parts.draw(s), torch.tensor(0.0, dtype=torch.float64)
            found = mppi_parts.mppi_plan(
                ZEROS, noise, None, floor, last, problem=point_problem(), settings=s
            )
        else:
            s = settings(change_cost=price)
            found = cem_plan(ZEROS, draw(s), None, last, problem=point_problem(), settings=s)
        return found.actions[0]

    far, near = ((first_action(price) - last).norm() for price in (0.0, 30.0))
    assert near < 0.5 * far


def test_the_planner_remembers_its_last_action_for_each_row():
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env, change_cost=1.0)
    seen = []
    plan = planner.plan

    def spy(tensordict, noise=None, mean=None, last=None):
        seen.append(last)
        return plan(tensordict, noise, mean, last)

    planner.plan = spy
    data = TensorDict(observation=torch.tensor([[1.0, 0.0, 0.0]]).repeat(2, 1), batch_size=[2])
    actions = [planner(data.clone().set("is_init", torch.tensor([[True], [True]])))["action"]]
    for second in (False, True):
        data["is_init"] = torch.tensor([[False], [second]])
        actions.append(planner(data.clone())["action"])
    assert seen[0].isnan().all()
    torch.testing.assert_close(seen[1], actions[0])
    torch.testing.assert_close(seen[2][0], actions[1][0])
    assert seen[2][1].isnan().all()
    planner.reset()
    planner(data.clone())
    assert seen[3].isnan().all()


# The plan that stands.


def keeping(**kwargs):
    return settings(warm_start=True, keep_incumbent=True, **kwargs)


def standing(problem):
    """A plan that is as good as any but for its last action, which the actor gives."""
    plan = torch.zeros(4, 2, dtype=torch.float64)
    plan[0] = 0.29
    return plan, torch.zeros(2, dtype=torch.float64)


def test_a_plan_within_the_margin_is_kept_and_completed_by_the_actor():
    problem = point_problem(half_way)
    mean, last = standing(problem)
    s = keeping(num_policy_candidates=5, incumbent_margin=0.05)
    found = cem_plan(ZEROS, draw(s), mean, last, problem=problem, settings=s)
    torch.testing.assert_close(found.actions[:3], mean[:3])
    torch.testing.assert_close(found.actions[3], half_way(mean[:3].sum(0)))


def test_a_better_plan_than_the_margin_replaces_it():
    problem = point_problem(half_way)
    mean, last = standing(problem)
    bad = mean.clone()
    bad[0] = -0.4
    s = keeping(num_policy_candidates=5, incumbent_margin=0.05)
    found = cem_plan(ZEROS, draw(s), bad, last, problem=problem, settings=s)
    scores, _ = score_sequences(ZEROS[None], bad[:, None], problem, gamma=0.99, alpha=1.0)
    assert found.score > scores[0] + 0.05
    assert not torch.equal(found.actions[:3], bad[:3])


def test_where_an_episode_starts_no_plan_stands():
    problem = point_problem(half_way)
    bad, last = standing(problem)
    bad[0] = -0.4
    s = keeping(incumbent_margin=10.0)
    for start, kept in ((last, True), (torch.full_like(last, torch.nan), False)):
        found = cem_plan(ZEROS, draw(s), bad, start, problem=problem, settings=s)
        assert torch.equal(found.actions[:3], bad[:3]) == kept


@pytest.mark.parametrize("policy", [0, 5])
@pytest.mark.parametrize("kept", [0, 3])
def test_the_plan_is_never_beaten_by_what_was_scored(monkeypatch, policy, kept):
    problem = point_problem(half_way if policy else None)
    mean, last = standing(problem)
    s = keeping(num_policy_candidates=policy, num_kept_elites=kept)
    seen = spy_on_scores(monkeypatch)
    found = cem_plan(ZEROS, draw(s), mean, last, problem=problem, settings=s)
    best = max(scores.max() for _, scores in seen)
    torch.testing.assert_close(found.score, best)


def test_rows_do_not_meet():
    problem = point_problem(half_way)
    mean, last = standing(problem)
    s = keeping(num_policy_candidates=5, change_cost=0.2)
    observation = torch.tensor([[0.0, 0.0], [0.2, -0.1]], dtype=torch.float64)
    noise, means, lasts = draw(s, (2,)), torch.stack([mean, -mean]), torch.stack([last, last + 0.3])
    both = cem_plan(observation, noise, means, lasts, problem=problem, settings=s)
    for i in range(2):
        one = cem_plan(
            observation[i], noise[:, :, :, i], means[i], lasts[i], problem=problem, settings=s
        )
        torch.testing.assert_close(one.actions, both.actions[i])


def test_wrong_settings_are_refused_by_name():
    with pytest.raises(ConfigError, match="keep_incumbent: expected false without warm_start"):
        CEMConfig(keep_incumbent=True)
    for kind in (CEMConfig, MPPIConfig):
        with pytest.raises(ConfigError, match="noise_beta: expected a number >= 0, got -1"):
            kind(noise_beta=-1)
        with pytest.raises(ConfigError, match="change_cost"):
            kind(change_cost=float("nan"))
    with pytest.raises(ConfigError, match="incumbent_margin"):
        CEMConfig(incumbent_margin=-0.1)
