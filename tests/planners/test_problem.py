"""What a sequence of actions is worth."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import pytest
import torch
from points import Point, bounds, point_problem

from phihp_torchrl.planners import Problem, score_sequences
from phihp_torchrl.tasks import ActionBounds


def test_score_by_hand():
    """Rewards are -1, -4 and Q is 10: -1 - 0.5 * 4 + 2 * 0.25 * 10."""
    problem = Problem(
        model=Point(goal=0.0),
        bounds=bounds((-9.0,), (9.0,)),
        actor=lambda observation: observation + 1,
        value=lambda observation, action: (observation + 4 * action - 4).squeeze(-1),
    )
    state = torch.zeros(1, 1, dtype=torch.float64)
    actions = torch.ones(2, 1, 1, dtype=torch.float64)
    scores, taken = score_sequences(state, actions, problem, gamma=0.5, alpha=2.0)
    assert scores.tolist() == [-1 - 0.5 * 4 + 2 * 0.25 * 10]
    assert taken is actions
    scores, _ = score_sequences(state, actions, problem, gamma=0.5, alpha=0.0)
    assert scores.tolist() == [-3.0]


def test_nothing_counts_after_a_termination():
    """The second and third of these leave the walls, at the first and at the last step."""
    problem = Problem(
        model=Point(goal=0.0, wall=1.5),
        bounds=bounds((-9.0,), (9.0,)),
        actor=lambda observation: observation,
        value=lambda observation, action: torch.full_like(observation[:, 0], 100.0),
    )
    actions = torch.tensor([[1.0, 2.0, 1.0], [-1.0, -2.0, 1.0]], dtype=torch.float64)
    state = torch.zeros(3, 1, dtype=torch.float64)
    scores, _ = score_sequences(state, actions.unsqueeze(-1), problem, gamma=0.5, alpha=1.0)
    assert scores.tolist() == [-1.0 + 25.0, -4.0, -1.0 - 0.5 * 4.0]


@pytest.mark.parametrize(("last", "completed"), [(None, 0), (nan, 2), (0.5, 2)])
def test_a_loop_of_a_graph_scores_as_one_step_after_another(last, completed):
    """Some sequences end, some leave the finite numbers, and some are the actor's."""
    problem = Problem(
        model=Point(goal=0.0, wall=3.0),
        bounds=bounds((-9.0,), (9.0,)),
        actor=lambda observation: 0.3 - observation,
        value=lambda observation, action: observation[:, 0] + action[:, 0],
    )
    generator = torch.Generator().manual_seed(0)
    actions = torch.randn(7, 20, 1, dtype=torch.float64, generator=generator)
    actions[3, 12] = inf
    state = torch.randn(20, 1, dtype=torch.float64, generator=generator)
    options = {
        "policy_noise": torch.randn(7, 5, 1, dtype=torch.float64, generator=generator),
        "last": None if last is None else torch.full((20, 1), last, dtype=torch.float64),
        "completed": completed,
    }
    apart, taken = score_sequences(
        state, actions, problem, gamma=0.9, alpha=0.5, change_cost=0.1, **options
    )
    problem = replace(problem, in_loop=True)
    scores, acted = torch.compile(score_sequences, backend="eager", fullgraph=True)(
        state, actions, problem, gamma=0.9, alpha=0.5, change_cost=0.1, **options
    )
    assert len(set(apart.isfinite().tolist())) == 2
    torch.testing.assert_close(scores, apart)
    torch.testing.assert_close(acted, taken)


def test_what_is_not_finite_after_a_termination_does_not_count():
    def reward(state, action, reward):
        return torch.where(state[..., 0] > 1.5, nan, reward)

    problem = Problem(model=Point(goal=0.0, wall=1.5, reward=reward), bounds=bounds((-9,), (9,)))
    actions = torch.full((3, 1, 1), 2.0, dtype=torch.float64)
    state = torch.zeros(1, 1, dtype=torch.float64)
    scores, _ = score_sequences(state, actions, problem, gamma=1.0, alpha=1.0)
    assert scores.tolist() == [-4.0]


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_scores_that_are_not_finite_are_the_worst(bad):
    def reward(state, action, reward):
        return torch.where(action[..., 0] > 0, bad, reward)

    problem = point_problem(goal=0.0, reward=reward)
    actions = torch.tensor([[[1.0, 0.0], [-1.0, 0.0]]], dtype=torch.float64)
    state = torch.zeros(2, 2, dtype=torch.float64)
    scores, _ = score_sequences(state, actions, problem, gamma=1.0, alpha=1.0)
    assert scores.tolist() == [-inf, -1.0]


def test_unbounded_actions_have_unit_scale():
    free = ActionBounds.from_limits(torch.tensor([-inf, 0.0]), torch.tensor([inf, 4.0]))
    assert free.center.tolist() == [0.0, 2.0]
    assert free.scale.tolist() == [1.0, 2.0]
