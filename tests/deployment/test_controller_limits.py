"""Whoever acts keeps to the task's limits, and is told what was sent."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from phihp_torchrl import Agent, Constraint, HybridDynamics, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import Controller, Safety
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.tasks import Actuator, Disturbance, Signal

from .agent_parts import SMALL, make_agent

PENDULUM = get_task("pendulum")
UPRIGHT = np.array([1.0, 0.0, 0.0])
LOST = [1.0, 0.0, float("nan")]
SLOW = replace(PENDULUM, name="slow", action_rate_limit=4.0)  # 0.2 a step


def policy(act):
    return TensorDictModule(act, ["observation"], ["action"])


def near(reference):
    return pytest.approx(reference, abs=1e-6)


def test_a_policy_and_those_who_take_over_keep_to_the_rate_of_the_task():
    wanted = iter([2.0, -2.0, 2.0])
    agent = policy(lambda o: torch.full((1,), next(wanted)))
    control = Controller(agent, SLOW, fallback=[lambda o: [2.0], "zero"])
    sent = [control.step(o).item() for o in (UPRIGHT, UPRIGHT, UPRIGHT, LOST, LOST)]
    assert sent == near([0.2, 0.0, 0.2, 0.4, 0.6])
    control = Controller(agent, SLOW, fallback="zero")
    control._last = torch.tensor([0.5])
    assert [control.step(LOST).item() for _ in range(3)] == near([0.3, 0.1, 0.0])


def test_a_limit_of_changes_holds_for_what_the_rate_leaves():
    control = Controller(policy(lambda o: 2.0 + 0 * o[:1]), SLOW, safety=Safety(max_change=0.5))
    assert control.step(UPRIGHT).item() == near(0.2)
    assert control.report().reasons == {}


def torque(state, action):
    return action[..., 0]


def test_a_fallback_that_violates_a_constraint_is_passed_over():
    limit = Constraint("torque", low=-1.0, high=1.0, price=1.0, function=torque)
    task = replace(PENDULUM, name="weak", constraints=(limit,))
    options = {"safety": Safety(constraints=True), "fallback": [lambda o: [1.9], lambda o: [0.9]]}
    control = Controller(policy(lambda o: 1.8 + 0 * o[:1]), task, **options)
    assert control.step(UPRIGHT).item() == near(0.9)


def test_outside_the_constraints_a_fallback_that_leads_back_acts_all_the_same():
    limit = Constraint("theta_dot", low=-1.0, high=1.0, price=1.0)
    task = replace(PENDULUM, name="slow-turn", constraints=(limit,))
    options = {"safety": Safety(constraints=True), "fallback": lambda o: [-1.0]}
    control = Controller(policy(lambda o: o[:1]), task, **options)
    assert control.step([1.0, 0.0, 2.0]).item() == -1.0


def distance(state, action, next_state, reference):
    return -(next_state[..., 0] - reference[..., 0]).abs()


def test_a_reference_that_is_not_finite_leaves_the_step_to_the_fallback():
    signal = Signal(("theta",), (-1.0,), (1.0,))
    task = replace(PENDULUM, name="tracked", reward=distance, reference=signal)
    seen = []

    def act(observation):
        seen.append(observation[3].item())
        return torch.ones(1)

    control = Controller(policy(act), task, fallback=lambda o: [-0.5])
    lost = float("nan")
    sent = [control.step(UPRIGHT, reference=[r]).item() for r in (lost, 0.3, lost, 0.4)]
    assert sent == [-0.5, 1.0, -0.5, 1.0]
    assert seen == near([0.3, 0.4])
    assert control.report().reasons == {"inputs": 2}
    control.step(UPRIGHT)  # and the last one that was finite stays
    assert seen[-1] == near(0.4)


@pytest.mark.parametrize("lost", [LOST, [0.5, 0.5, 0.0]], ids=["not finite", "implausible"])
@pytest.mark.parametrize("fallback", ["actor", "user"])
def test_steps_without_an_observation_leave_the_estimate_of_a_disturbance(lost, fallback):
    task = replace(PENDULUM, name="pushed", disturbance=Disturbance(high={"theta_dot": 5.0}))
    config = CEMConfig(2, optim_steps=1, num_candidates=8, top_k=2, num_policy_candidates=2)
    model = HybridDynamics.pure_prior(task)
    agent = Agent(task, dynamics=model, actor=Actor(task), planner_config=config)
    control = Controller(agent, fallback=fallback if fallback == "actor" else lambda o: [-2.0])
    state, push = torch.tensor([0.3, 0.0]), torch.tensor([0.0, 1.5])
    estimates = []
    with torch.no_grad():
        for k in range(60):
            observation = lost if 30 <= k < 40 else task.system.observe(state)
            action = torch.tensor(control.step(observation))
            state = model.step(state, action) + task.time_step * push
            estimates.append(control.estimate.item())
    assert estimates[29:] == pytest.approx([1.5] * 31, abs=0.02)


def test_an_agent_that_was_overruled_goes_on_from_what_was_sent():
    agent = make_agent(config=replace(SMALL, change_cost=1.0))
    fits = iter([True, False, True])
    control = Controller(agent, accept=lambda o, a: next(fits), fallback=lambda o: [-2.0])
    began = []

    def planning(tensordict, *_, plan=agent.planner.planning):
        began.append(agent.planner.receding.last_action(None, torch.zeros(1)).item())
        return plan(tensordict)

    agent.planner.planning = planning
    own = control.step(UPRIGHT).item()
    control.step(UPRIGHT)
    control.step(LOST)
    control.step(UPRIGHT)
    assert np.isnan(began[0])
    assert began[1:] == [own, -2.0]


def test_a_step_in_which_the_agent_failed_counts_as_missed():
    agent, heard = make_agent(config=replace(SMALL, warm_start=True)), []
    fails = iter([False, True, False])

    class Failing(Agent):
        def _plan(self, tensordict):
            if next(fails):
                raise RuntimeError("no")
            return super()._plan(tensordict)

        def follow(self, sent, missed=0):
            heard.append((sent.item(), missed))

    parts = {name: getattr(agent, name) for name in ("dynamics", "actor", "qvalue")}
    failing = Failing(agent.task, **parts, planner_config=agent.planner_config)
    control = Controller(failing, fallback=lambda o: [-2.0])
    own = control.step(UPRIGHT).item()
    for _ in range(2):
        control.step(UPRIGHT)
    assert heard == [(own, 0), (-2.0, 1)]


def test_an_agent_of_ones_own_acts_by_its_own_forward():
    task = replace(PENDULUM, name="pushed", disturbance=Disturbance(high={"theta_dot": 5.0}))

    class Halved(Agent):
        def forward(self, tensordict, tensordict_out=None):
            acted = super().forward(tensordict, tensordict_out)
            return acted.set("action", 0.0 * acted["action"] + 0.125)

    agent = Halved(task, dynamics=HybridDynamics.pure_prior(task), actor=Actor(task))
    assert Controller(agent).step(UPRIGHT).item() == 0.125


def test_an_agent_completes_what_its_controller_does_not_know_of():
    task = replace(PENDULUM, name="late", actuator=Actuator(delay_steps=1.0))
    control = Controller(Agent(task, actor=Actor(task)), task="pendulum", fallback="zero")
    control.step(UPRIGHT)
    assert control.report().reasons == {}


@pytest.mark.parametrize("lost", ["reference", "observation"])
def test_what_is_sent_before_the_first_step_of_the_agent_is_under_way(lost):
    signal = Signal(("theta",), (-1.0,), (1.0,))
    changes = {"reward": distance, "reference": signal, "actuator": Actuator(delay_steps=1.0)}
    task, seen = replace(PENDULUM, name="late-tracked", **changes), []

    def act(observation):
        seen.append(observation.tolist())
        return torch.ones(1)

    control = Controller(policy(act), task, fallback=lambda o: [1.5])
    if lost == "reference":
        control.step(UPRIGHT, reference=[float("nan")])
    else:
        control.step(LOST, reference=[0.25])
    control.step(UPRIGHT, reference=[0.5])
    assert sorted(seen[0][3:]) == near([0.5, 0.75])  # in half-ranges


def test_an_agent_that_is_late_at_first_is_told_what_was_sent():
    begun, waits, told = [], threading.Event(), []

    class Slow(TensorDictModule):
        def follow(self, sent, missed=0):
            told.append((sent.item(), missed))

    def act(observation, is_init):
        begun.append(is_init.item())
        if len(begun) == 1:
            waits.wait(20)
        return torch.ones(1)

    agent = Slow(act, ["observation", "is_init"], ["action"])
    control = Controller(agent, PENDULUM, safety=Safety(deadline=0.2), fallback=lambda o: [0.5])
    sent = [control.step(UPRIGHT).item() for _ in range(2)]
    waits.set()
    control._worker._running.result(20)
    sent.append(control.step(UPRIGHT).item())
    control.close()
    assert sent == [0.5, 0.5, 1.0]
    assert begun == [True, False]
    assert told == [(0.5, 1)]
