"""Several steps of one plan, and the next plan that starts from where it left off."""

from __future__ import annotations

import torch
from lopsided import LOPSIDED
from tensordict import TensorDict

from phihp_torchrl.planners.candidates import Plan

from .planner_parts import make_planner, noise_for, task_parts


def scripted(planner, monkeypatch):
    """Plans that count: step k of plan p is 10 p + k. Returns the list of means given."""
    means = []

    def plan_of(tensordict, noise=None, mean=None, last=None):
        number, horizon = len(means), planner.settings.planning_horizon
        means.append(mean)
        sequence = 10.0 * number + torch.arange(horizon)
        shape = (*tensordict.batch_size, horizon, 1)
        return Plan(sequence.unsqueeze(-1).expand(shape), torch.zeros(tensordict.batch_size))

    monkeypatch.setattr(planner, "plan", plan_of)
    return means


def test_replan_every(monkeypatch):
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env, replan_every=3)
    means = scripted(planner, monkeypatch)
    tensordict = TensorDict(batch_size=[])
    assert [planner.planning(tensordict).item() for _ in range(7)] == [0, 1, 2, 10, 11, 12, 20]
    planner.reset()
    assert planner.planning(tensordict) == 30
    assert means == [None] * 4


def test_each_row_of_a_batch_has_its_own_episode(monkeypatch):
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env, replan_every=3, warm_start=True)
    means = scripted(planner, monkeypatch)
    tensordict = TensorDict(is_init=torch.tensor([[True], [True]]), batch_size=[2])
    actions = [planner.planning(tensordict).flatten().tolist()]
    for second_starts in (False, True, False, False, False):
        tensordict["is_init"] = torch.tensor([[False], [second_starts]])
        actions.append(planner.planning(tensordict).flatten().tolist())
    assert actions == [[0, 0], [1, 1], [2, 10], [20, 11], [21, 12], [22, 30]]
    assert means[0].abs().max() == 0  # nothing to start from
    assert means[1][1].abs().max() == 0  # the row that starts anew
    assert means[2][0].flatten().tolist() == [3, 0, 0, 0]  # the rest of the first plan
    assert means[3][1].flatten().tolist() == [13, 0, 0, 0]
    assert planner.planning(TensorDict(batch_size=[])).item() == 40  # another batch, another life


def test_what_follows_the_end_of_a_plan_is_the_middle_of_the_bounds(monkeypatch):
    """From -6 to 12 the middle is 3."""
    _, env, _, _ = task_parts(LOPSIDED)
    planner = make_planner(env, warm_start=True)
    means = scripted(planner, monkeypatch)
    for _ in range(2):
        planner.planning(TensorDict(batch_size=[]))
    assert means[0].flatten().tolist() == [3.0] * 4
    assert means[1].flatten().tolist() == [1.0, 2.0, 3.0, 3.0]


def test_plans_move_up_by_the_steps_in_which_others_acted(monkeypatch):
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env, warm_start=True)
    means = scripted(planner, monkeypatch)
    data = TensorDict(batch_size=[])
    planner.receding.follow(torch.tensor([0.5]), missed=7)  # there is no plan yet
    planner.planning(data)
    planner.receding.follow(torch.tensor([2.0]), missed=2)
    assert planner.receding.last_action(None, torch.zeros(1)) == 2.0
    for _ in range(2):
        planner.planning(data)
    # Of 0 to 3 the action 0 was to be taken, and two more steps have gone by.
    assert [mean.flatten().tolist() for mean in means[1:]] == [[3, 0, 0, 0], [11, 12, 13, 0]]


def test_a_plan_of_several_steps_is_over_earlier_where_others_acted(monkeypatch):
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env, replan_every=3)
    scripted(planner, monkeypatch)
    data = TensorDict(batch_size=[])
    planner.planning(data)
    planner.receding.follow(torch.zeros(1), missed=1)
    assert [planner.planning(data).item() for _ in range(2)] == [2, 10]


def test_a_warm_plan_of_several_steps_moves_up_by_all_that_went_by(monkeypatch):
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env, replan_every=2, warm_start=True)
    means = scripted(planner, monkeypatch)
    data = TensorDict(batch_size=[2])
    planner.receding.follow(torch.zeros(2, 1), missed=5)  # there is no plan yet
    planner.planning(data)
    planner.receding.follow(torch.zeros(2, 1), missed=2)
    planner.planning(data)
    assert means[1].flatten().tolist() == [3, 0, 0, 0] * 2


def test_a_warm_start_remembers():
    task, env, _, _ = task_parts("pendulum-swingup")
    planner = make_planner(env, planning_horizon=15, optim_steps=1, warm_start=True)
    cold = make_planner(env, planning_horizon=15, optim_steps=1)
    tensordict = TensorDict(observation=task.observe(torch.tensor([3.0, 0.0])))
    gains = []
    for seed in range(20):
        noise = noise_for(planner, seed=seed)
        planner.reset()
        for _ in range(5):
            planner.planning(tensordict, noise)
        mean = planner.receding._plans
        gains.append(
            planner.plan(tensordict, noise, mean).score - cold.plan(tensordict, noise).score
        )
    assert torch.stack(gains).mean() > 0
