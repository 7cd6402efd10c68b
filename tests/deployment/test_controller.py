"""A controller always has a fit action, carries what was sent, and counts who took over."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from phihp_torchrl import Agent, Constraint, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment import Controller, Safety
from phihp_torchrl.tasks import Actuator

from .agent_parts import make_agent

UPRIGHT = np.array([1.0, 0.0, 0.0])
PENDULUM = get_task("pendulum")


def policy(act):
    return TensorDictModule(act, ["observation"], ["action"])


def controller(act, **options):
    return Controller(policy(act), PENDULUM, **options)


def test_it_acts_as_its_agent_does():
    agent = make_agent()
    control = Controller(agent)
    for observation in PENDULUM.observe(PENDULUM.reset.sample([3])):
        torch.manual_seed(0)
        expected = agent(TensorDict(observation=observation))["action"]
        for given in (observation, observation.numpy(), observation.tolist()):
            torch.manual_seed(0)
            action = control.step(given)
            assert action.dtype == np.float32
            assert action.tolist() == expected.tolist()
    assert control.report().reasons == {}


@pytest.mark.parametrize("deadline", [None, 10.0])
def test_what_is_sent_is_remembered_as_sent(deadline):
    """An overruled agent sees the command that really is under way."""
    task = replace(PENDULUM, actuator=Actuator(delay_steps=2.0))
    seen = []

    def act(observation):
        seen.append(observation[3:].tolist())
        return torch.full((1,), float("nan") if len(seen) == 1 else 1.0)

    control = Controller(
        policy(act), task, fallback=lambda o: [-2.0], safety=Safety(deadline=deadline)
    )
    sent = [control.step(UPRIGHT).item() for _ in range(4)]
    assert sent == [-2.0, 1.0, 1.0, 1.0]
    assert seen == [[0.0, 0.0], [0.0, -1.0], [-1.0, 0.5], [0.5, 0.5]]  # in half-ranges
    control.reset()
    control.step(UPRIGHT)
    assert seen[-1] == [0.0, 0.0]
    control.close()


@pytest.mark.parametrize(
    ("reason", "action"), [("not_finite", float("nan")), ("bounds", 2.5), ("rate", 1.0)]
)
def test_an_unfit_action_is_replaced(reason, action):
    control = controller(
        lambda o: torch.full((1,), action), fallback="zero", safety=Safety(max_change=0.5)
    )
    assert control.step(UPRIGHT).tolist() == [0.0]
    report = control.report()
    assert (report.reasons, report.taken_by, report.longest) == ({reason: 1}, {"zero": 1}, 1)


def test_an_agent_that_fails_and_one_that_is_refused():
    def fails(observation):
        raise RuntimeError("no")

    control = controller(fails)
    assert control.step(UPRIGHT).tolist() == [0.0]
    assert control.report().reasons == {"error": 1}
    control = controller(lambda o: torch.ones(1), accept=lambda o, a: bool(o[2] * a[0] <= 0.0))
    assert control.step(UPRIGHT).tolist() == [1.0]
    assert control.step([1.0, 0.0, 3.0]).tolist() == [1.0]  # the one before is held
    assert control.report().reasons == {"refused": 1}


def test_bad_observations():
    safety = Safety(plausible={"theta_dot": (-9.0, 8.5)}, max_age=0.1)
    control = controller(lambda o: torch.ones(1), safety=safety, clock=lambda: 10.0)
    stamps = [9.95, 9.96, 9.97, 9.98, 9.98, 9.5, 9.99]
    seen = [UPRIGHT, [1, 0, np.inf], [0.5, 0.5, 0], [1, 0, 8.6], UPRIGHT, UPRIGHT, UPRIGHT]
    for observation, stamp in zip(seen, stamps, strict=True):
        assert control.step(observation, timestamp=stamp).tolist() == [1.0]
    report = control.report()
    assert report.reasons == {"observation": 1, "implausible": 2, "stale": 2}
    assert (report.steps, report.overruled, report.longest) == (7, 5, 5)
    control.clear_report()
    assert control.report().summary() == {"steps": 0.0, "overruled": 0.0}


def test_the_last_action_is_held_for_a_while_and_then_let_go_within_the_rate():
    actions = iter([0.8, 1.6] + [float("nan")] * 6)
    safety = Safety(hold_steps=2, max_change=1.0)
    control = controller(lambda o: torch.tensor([next(actions)]), safety=safety)
    sent = [round(control.step(UPRIGHT).item(), 3) for _ in range(7)]
    assert sent == [0.8, 1.6, 1.6, 1.6, 0.6, 0.0, 0.0]
    assert control.report().taken_by == {"hold": 2, "zero": 3}


def test_a_late_plan_is_given_up_and_the_actor_acts():
    agent, wait = make_agent(), threading.Event()

    class Slow(Agent):
        def _plan(self, tensordict):
            if self.late:
                wait.wait(20)
            return super()._plan(tensordict)

    slow = Slow(
        agent.task, dynamics=agent.dynamics, actor=agent.actor, qvalue=agent.qvalue,
        planner_config=agent.planner_config,
    )  # fmt: skip
    slow.late = False
    control = Controller(slow, safety=Safety(deadline=0.5))
    control.warm_up(1)
    slow.late = True
    expected = agent.actor_alone()(TensorDict(observation=torch.tensor([1.0, 0.0, 0.0])))["action"]
    assert control.step(UPRIGHT).tolist() == expected.tolist()
    begun = control.report().milliseconds[0]
    assert 500 <= begun < 5000
    control.step(UPRIGHT)  # the late plan is still at work, so nobody waits
    assert control.report().milliseconds[1] < 400
    assert control.report().reasons == {"late": 2}
    assert control.report().taken_by == {"actor": 2}
    slow.late = False
    wait.set()
    control._worker._running.result(20)
    control.step(UPRIGHT)
    assert control.report().reasons == {"late": 2}
    control.close()


def test_fallbacks_that_pass_or_fail_leave_it_to_the_next():
    def broken(observation):
        raise ValueError("no")

    order = [lambda o: None, broken, lambda o: [0.0, 0.0], lambda o: [9.0], lambda o: [0.3]]
    control = controller(lambda o: torch.full((1,), float("nan")), fallback=order)
    assert control.step(UPRIGHT).tolist() == pytest.approx([0.3])


def test_warming_up_says_how_long_an_action_takes_and_forgets(caplog):
    torch.manual_seed(0)
    before = torch.random.get_rng_state()
    clock = iter(np.arange(0.0, 100.0, 0.03))
    control = controller(
        lambda o: torch.ones(1), safety=Safety(deadline=0.01), clock=lambda: next(clock)
    )
    assert control.warm_up(3)["p50_ms"] == pytest.approx(30.0)
    assert "the deadline is 10.0 ms" in caplog.text
    assert control.report().steps == 0
    assert torch.equal(torch.random.get_rng_state(), before)
    control.close()


def test_what_does_not_fit_is_named():
    agent = Agent(PENDULUM, actor=Actor(PENDULUM))
    cases = {
        "fallback": {"fallback": "brake"},
        "plausible.x": {"safety": Safety(plausible={"x": 1.0})},
        "max_change": {"safety": Safety(max_change=(1.0, 1.0))},
    }
    for key, options in cases.items():
        with pytest.raises(ValueError, match=f"^{key}: expected"):
            Controller(agent, **options)
    with pytest.raises(ValueError, match=r"^fallback: expected an agent that plans"):
        Controller(agent, fallback="actor")
    with pytest.raises(ValueError, match=r"^task: expected one"):
        Controller(policy(lambda o: o))
    with pytest.raises(ValueError, match=r"^observation: expected shape \[3\], got \[2\]"):
        Controller(agent).step([1.0, 0.0])
    for name in ("deadline", "max_age", "mismatch", "max_change"):
        with pytest.raises(ValueError, match=f"^{name}: expected"):
            Safety(**{name: 0.0})


def test_the_fallback_takes_over_outside_the_constraints_of_the_task():
    """The agent acts at 0.5 rad/s and not at 2; and never with more than 1 W."""
    slow = Constraint("theta_dot", low=-1.0, high=1.0, price=1.0)
    power = Constraint(
        "power", high=0.9, price=1.0, function=lambda s, action: s[..., 1] * action[..., 0]
    )
    for constraints, reasons in (((slow,), 1), ((slow, power), 2)):
        task = replace(PENDULUM, constraints=constraints)
        agent = policy(lambda o: torch.full((1,), 2.0))
        control = Controller(
            agent, task, safety=Safety(constraints=True), fallback=lambda o: [-1.0]
        )
        sent = [control.step([1.0, 0.0, speed]).item() for speed in (0.0, 0.5, 2.0)]
        assert sent == [2.0, 2.0 if reasons == 1 else -1.0, -1.0]
        assert control.report().reasons == {"constraint": reasons}
    free = Controller(agent, task)
    assert free.step([1.0, 0.0, 2.0]).item() == 2.0
    with pytest.raises(ConfigError, match="constraints: expected a task with constraints"):
        controller(lambda o: o, safety=Safety(constraints=True))
