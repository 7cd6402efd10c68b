"""MPPIPlanner as a module: backends, the mean that it keeps, exploration, schedules."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from lopsided import LOPSIDED
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from phihp_torchrl import MPPIPlanner, WorldModelEnv, get_task
from phihp_torchrl.tasks import find_task
from phihp_torchrl.worlds import SimulatedWorld

from .mppi_parts import settings


def make_planner(task="pendulum-swingup", **kwargs):
    env = WorldModelEnv(SimulatedWorld(task).model(), seed=0)
    options = {k: kwargs.pop(k) for k in ("backend", "generator") if k in kwargs}
    s = settings(num_candidates=32, top_k=4, select="sample", **kwargs)
    return MPPIPlanner(env, s, **options)


def situation(*batch, task="pendulum-swingup", seed=0):
    task = find_task(task)
    state = task.reset.sample([*batch], generator=torch.Generator().manual_seed(seed))
    return TensorDict(observation=task.observe(state), state=state, batch_size=batch)


def test_both_backends_agree():
    task = get_task("cartpole")
    env = WorldModelEnv(SimulatedWorld(task).model(), seed=0)
    planners = [MPPIPlanner(env, settings(), backend=b) for b in ("tensor", "env")]
    state = task.reset.sample([3], generator=torch.Generator().manual_seed(0))
    td = TensorDict(observation=task.observe(state), state=state, batch_size=[3])
    noise = planners[0].draw_noise([3])
    plans = [planner.plan(td, noise) for planner in planners]
    for a, b in zip(*plans, strict=True):
        torch.testing.assert_close(a, b)


def test_a_plan_starts_from_the_one_before_shifted():
    planner = make_planner(momentum=0.9)
    td = situation(2)
    seen = []
    plan_once = planner.plan

    def spy(tensordict, noise, mean, last):
        seen.append(mean)
        return plan_once(tensordict, noise, mean, last)

    planner.plan = spy
    planner(td.clone())
    first = planner.receding.recall(None, torch.zeros(2, 4, 1))
    planner(td.clone())
    assert not seen[0].any()
    torch.testing.assert_close(seen[1], first)
    assert seen[1][:, :3].any()
    assert not seen[1][:, 3].any()
    planner(td.clone().set("is_init", torch.tensor([[True], [False]])))
    assert not seen[2][0].any()
    assert seen[2][1].any()
    planner.reset()
    planner(td.clone())
    assert not seen[3].any()


def test_exploration_is_noise_of_the_std_that_is_left():
    """Deterministic is the default; RANDOM adds noise, which is clipped to the bounds."""
    planner = make_planner(min_std=0.9, generator=torch.Generator())
    actions = {}
    for kind in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        planner.generator.manual_seed(3)
        planner.reset()
        with set_exploration_type(kind):
            actions[kind] = planner(situation(400))["action"]
    noise = actions[ExplorationType.RANDOM] - actions[ExplorationType.DETERMINISTIC]
    assert noise.std() > 0.5
    assert (actions[ExplorationType.RANDOM].abs() <= 2.0).all()


def test_a_cold_start_and_exploration_within_lopsided_bounds():
    """From -6 to 12 a plan starts from 3, and noise reaches either bound and no further."""
    planner = make_planner(LOPSIDED, min_std=0.9, generator=torch.Generator().manual_seed(0))
    td = situation(400, task=LOPSIDED)
    with set_exploration_type(ExplorationType.RANDOM):
        action = planner(td)["action"]
    assert action.min().item() == -6.0
    assert action.max().item() == 12.0
    cold = torch.full((400, 4, 1), 3.0)
    planner.reset()
    assert torch.equal(planner.receding.recall(None, cold), cold)
    seen, plan_once = [], planner.plan

    def spy(tensordict, noise, mean, last):
        seen.append(mean)
        return plan_once(tensordict, noise, mean, last)

    planner.plan = spy
    planner(td)
    planner(td)
    assert torch.equal(seen[0], cold)
    assert (seen[1][:, 3] == 3.0).all()


def test_settings_may_be_assigned_anew():
    planner = make_planner()
    assert planner.plan(situation(2)).mean.shape == (2, 4, 1)
    planner.settings = replace(planner.settings, planning_horizon=3, min_std=0.3)
    found = planner.plan(situation(2))
    assert found.mean.shape == (2, 3, 1)
    assert (found.std >= 0.3 * 2.0 - 1e-6).all()
    planner(situation(2))
    planner.settings = replace(planner.settings, planning_horizon=5, optim_steps=1, top_k=2)
    assert planner(situation(2))["action"].shape == (2, 1)
    assert planner.plan(situation(2)).mean.shape == (2, 5, 1)


def test_a_bad_observation_is_named():
    with pytest.raises(ValueError, match="observation: expected"):
        make_planner()(TensorDict(observation=torch.zeros(2, 5), batch_size=[2]))


def test_a_number_without_an_actor_is_refused_by_name():
    with pytest.raises(ValueError, match=r"^actor: .* num_policy_candidates=3 sequences"):
        make_planner(num_policy_candidates=3)
