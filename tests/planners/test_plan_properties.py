"""Whatever the settings and bounds: plans stay in bounds, in rows of their own, and unbeaten."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from points import Point, half_way, point_problem

from phihp_torchrl.planners import (
    CEMConfig,
    MPPIConfig,
    MPPINoise,
    Problem,
    cem_plan,
    mppi_plan,
)
from phihp_torchrl.tasks import ActionBounds

from .cem_parts import flat_value, spy_on_scores

SEEDS = st.integers(0, 2**31)


@st.composite
def searches(draw, config, **fixed):
    """Settings of any size; the first of the candidates may be an actor's."""
    candidates = draw(st.integers(2, 24))
    numbers = {
        "planning_horizon": draw(st.integers(1, 4)),
        "optim_steps": draw(st.integers(1, 3)),
        "num_candidates": candidates,
        "num_policy_candidates": draw(st.integers(0, candidates - 1)),
        "policy_noise": draw(st.floats(0, 3)),
        "policy_noise_clip": draw(st.floats(0, 2)),
        "alpha": draw(st.floats(0, 2)),
        "gamma": draw(st.floats(0, 1)),
        "init_std": draw(st.floats(0.1, 5)),
        "min_std": draw(st.floats(0, 0.1)),
    }
    if config is CEMConfig:
        numbers["top_k"] = draw(st.integers(1, candidates))
        numbers["num_kept_elites"] = draw(st.integers(0, numbers["top_k"]))
        numbers["compare_with_actor"] = draw(st.booleans())
        numbers["select"] = draw(st.sampled_from(["mean", "best"]))
    else:
        numbers["top_k"] = draw(st.integers(1, candidates))
        numbers["temperature"] = draw(st.floats(0, 10))
        numbers["momentum"] = draw(st.floats(0, 0.9))
        numbers["select"] = draw(st.sampled_from(["mean", "sample"]))
    return config(**{**numbers, **fixed})


@st.composite
def limits(draw):
    """Bounds of two actions, hardly ever symmetric."""
    low = torch.tensor([draw(st.floats(-10, 5)) for _ in range(2)], dtype=torch.float64)
    width = torch.tensor([draw(st.floats(0.1, 20)) for _ in range(2)], dtype=torch.float64)
    return ActionBounds.from_limits(low, low + width)


def noise_of(settings, rows, seed):
    """Standard normal noise for so many rows, heavy enough to meet the bounds."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return 2 * torch.randn(shape, generator=generator, dtype=torch.float64)

    if isinstance(settings, CEMConfig):
        return normal(*settings.noise_shape((rows,), 2))
    s, guided = settings, settings.num_policy_candidates
    return MPPINoise(
        normal(s.optim_steps, s.planning_horizon, s.num_candidates - guided, rows, 2),
        normal(s.planning_horizon, guided, rows, 2),
        torch.rand(s.top_k, rows, generator=generator, dtype=torch.float64),
    )


def row_of(noise, i):
    if isinstance(noise, MPPINoise):
        return MPPINoise(noise.samples[:, :, :, i], noise.policy[:, :, i], noise.choice[:, i])
    return noise[:, :, :, i]


def make_plan(observation, noise, settings, problem):
    if isinstance(settings, CEMConfig):
        return cem_plan(observation, noise, problem=problem, settings=settings)
    floor = torch.tensor(settings.min_std, dtype=torch.float64)
    return mppi_plan(observation, noise, None, floor, problem=problem, settings=settings)


def starts(seed, rows):
    generator = torch.Generator().manual_seed(seed + 1)
    return 3 * torch.randn(rows, 2, generator=generator, dtype=torch.float64)


both = pytest.mark.parametrize("config", [CEMConfig, MPPIConfig])


@both
@given(st.data(), limits(), SEEDS)
@examples(max_examples=30)
def test_plans_stay_in_bounds(config, data, bounds, seed):
    s = data.draw(searches(config))
    problem = point_problem(lambda observation: 100 * observation, flat_value, limits=bounds)
    found = make_plan(starts(seed, 3), noise_of(s, 3, seed), s, problem)
    assert found.actions.shape == (3, s.planning_horizon, 2)
    assert (found.actions >= bounds.low).all()
    assert (found.actions <= bounds.high).all()
    assert found.score.isfinite().all()


@both
@given(st.data(), limits(), SEEDS)
@examples(max_examples=30)
def test_a_batch_planned_at_once_is_its_rows_planned_alone(config, data, bounds, seed):
    s = data.draw(searches(config))
    problem = point_problem(half_way, flat_value, limits=bounds, wall=4.0)
    observation, noise = starts(seed, 3), noise_of(s, 3, seed)
    whole = make_plan(observation, noise, s, problem)
    for i in range(3):
        alone = make_plan(observation[i], row_of(noise, i), s, problem)
        for one, all_of_them in zip(alone, whole, strict=True):
            torch.testing.assert_close(one, all_of_them[i])


@given(searches(CEMConfig, select="best"), limits(), SEEDS)
@examples(max_examples=30)
def test_the_best_plan_is_never_beaten_by_its_own_candidates(s, bounds, seed):
    problem = point_problem(half_way, flat_value, limits=bounds, wall=4.0)
    with pytest.MonkeyPatch.context() as patch:
        seen = spy_on_scores(patch)
        found = make_plan(starts(seed, 1)[0], noise_of(s, 1, seed)[:, :, :, 0], s, problem)
    assert found.score == max(scores.max() for _, scores in seen)


@both
@given(st.data(), limits(), SEEDS)
@examples(max_examples=30)
def test_no_plan_is_beaten_by_the_actors_own_sequence(config, data, bounds, seed):
    """Of CEM where it is told to compare; the best elite of MPPI, whose actor always competes."""
    fixed = {"compare_with_actor": True} if config is CEMConfig else {}
    s = data.draw(searches(config, **fixed).filter(lambda s: s.num_policy_candidates > 0))
    problem = point_problem(half_way, flat_value, limits=bounds)
    with pytest.MonkeyPatch.context() as patch:
        seen = spy_on_scores(patch)
        noise = row_of(noise_of(s, 1, seed), 0)
        found = make_plan(starts(seed, 1)[0], noise, s, problem)
    assert found.score >= seen[0][1][0]


class InUnits(Point):
    """Moves by its action in units of the half-range of some bounds."""

    def __init__(self, bounds, **kwargs):
        super().__init__(**kwargs)
        self.bounds = bounds

    def transition(self, state, action):
        return super().transition(state, self.bounds.to_unit(action))


@both
@given(st.data(), limits(), SEEDS)
@examples(max_examples=30)
def test_bounds_are_only_a_unit_of_measure(config, data, bounds, seed):
    """The same problem in other units has the same plan, in those units."""
    s = data.draw(searches(config))
    one = torch.ones(2, dtype=torch.float64)
    unit = ActionBounds.from_limits(-one, one)
    plans = [
        make_plan(
            starts(seed, 2),
            noise_of(s, 2, seed),
            s,
            Problem(
                InUnits(b),
                b,
                lambda observation, b=b: b.from_unit(half_way(observation)),
                lambda observation, action, b=b: flat_value(observation, b.to_unit(action)),
            ),
        )
        for b in (unit, bounds)
    ]
    torch.testing.assert_close(bounds.from_unit(plans[0].actions), plans[1].actions)
    torch.testing.assert_close(plans[0].score, plans[1].score)
