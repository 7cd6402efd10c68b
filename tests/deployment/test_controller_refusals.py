"""What a caller gives that cannot be right is refused by its name, and what fails does not stop."""

from __future__ import annotations

import logging
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from phihp_torchrl import Agent, Constraint, HybridDynamics, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.baselines import ILQR, LQI, PID
from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment import Controller, Safety, VelocityObserver
from phihp_torchrl.deployment.entries import as_numbers
from phihp_torchrl.deployment.exported import ExportedAgent
from tests.followed import AIM, Mass, disturbed, followed

PENDULUM = get_task("pendulum")
UPRIGHT = [1.0, 0.0, 0.0]


def policy(act, *keys):
    return TensorDictModule(act, ["observation", *keys], ["action"])


def still(observation):
    return torch.zeros(1)


def fails(*given):
    raise RuntimeError("no")


def test_an_exported_agent_estimates_a_disturbance_by_the_model_that_it_is_given():
    task = disturbed()
    agent, model = ExportedAgent(still, task), HybridDynamics.pure_prior(task)
    control, state = Controller(agent, dynamics=model), torch.zeros(2)
    for _ in range(40):
        action = torch.tensor(control.step(state, reference=[0.5]))
        with torch.no_grad():
            state = model.step(state, action + 1.25)
    assert control.estimate.item() == pytest.approx(1.25, abs=1e-3)


def trained(task):
    return Agent(task, actor=Actor(task, (4,)))


def exported(task):
    return ExportedAgent(still, task)


@pytest.mark.parametrize("make", [exported, trained])
def test_a_trained_agent_without_a_model_refuses_observations_without_an_estimate(make, caplog):
    task = disturbed()
    control = Controller(make(task))
    assert "dynamics: neither it nor the agent has a model" in caplog.text
    with pytest.raises(ValueError, match=r"^observation: expected shape \[4\], with the estimate"):
        control.step([0.0, 0.0], reference=[0.5])
    control.step([0.0, 0.0, 0.5, 0.25])
    assert control.report().reasons == {}
    with pytest.raises(ConfigError, match=r"^dynamics: expected a model, .* disturbance"):
        Controller(make(task), observer=VelocityObserver(task))


def test_any_other_module_has_an_estimate_of_0_and_a_warning_says_so(caplog):
    seen = []
    control = Controller(policy(lambda o: (seen.append(o.tolist()), still(o))[1]), disturbed())
    (record,) = caplog.records
    assert "counts as an estimate of 0" in record.getMessage()
    for _ in range(2):
        control.step([0.0, 0.0], reference=[0.5])
    assert seen == [[0.0, 0.0, 0.5, 0.0]] * 2


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("kind", [PID, LQI, ILQR])
def test_a_baseline_has_the_model_that_it_was_made_in(kind, wrapped, caplog):
    task = disturbed()
    model, state = HybridDynamics.pure_prior(task), torch.zeros(2)
    agent = kind.from_model(task, model)
    control = Controller(Agent(task, actor=agent) if wrapped else agent)
    for _ in range(5 if kind is ILQR else 40):
        action = torch.tensor(control.step(state, reference=[0.5]))
        with torch.no_grad():
            state = model.step(state, action + 1.25)
    assert control.estimate.item() > 0.9
    assert caplog.records == []


@pytest.mark.parametrize("known", [False, True])
def test_an_estimate_of_the_caller_is_kept(known):
    """Also where there is a model, in the controller or in the agent."""
    task, seen = disturbed(), []
    actor = policy(lambda o: (seen.append(o.tolist()), torch.ones(1))[1])
    model = HybridDynamics.pure_prior(task)
    control = Controller(Agent(task, actor=actor, dynamics=model if known else None))
    given = [[0.0, 0.0, 0.5, 0.25], [0.25, 0.5, 0.5, -0.5], [0.25, 0.0, 0.5, 1.0]]
    for each in given:
        control.step(each)
    assert seen == given
    assert control.estimate is None
    assert control.report().reasons == {}


class Restless(nn.Module):
    """A network whose `reset` and `follow` are of its own making."""

    def forward(self, observation):
        return observation[..., :1]

    def reset(self, batch):
        raise AssertionError("nobody asked for that")

    follow = reset


def test_a_networks_own_reset_and_follow_are_left_alone():
    for agent in (policy(Restless()), Agent(PENDULUM, actor=policy(Restless()))):
        control = Controller(agent, PENDULUM, accept=lambda o, a: False, fallback="zero")
        for _ in range(2):
            control.step(UPRIGHT)
        assert control.report().reasons == {"refused": 2}


def test_an_accept_that_raises_refuses_the_action_and_is_logged_once(caplog):
    control = Controller(policy(lambda o: torch.ones(1)), PENDULUM, accept=fails, fallback="zero")
    with caplog.at_level(logging.ERROR):
        assert [control.step(UPRIGHT).tolist() for _ in range(3)] == [[0.0]] * 3
    assert control.report().reasons == {"refused": 3}
    assert caplog.text.count("RuntimeError: no") == 1
    assert "accept" in caplog.records[0].getMessage()


def test_a_constraint_that_raises_counts_as_violated_and_is_logged_once(caplog):
    def broken(state, action):
        return fails() if active else state[..., 1]

    active = False
    limit = Constraint("broken", high=1.0, price=1.0, function=broken)
    task = replace(PENDULUM, name="limited", constraints=(limit,))
    agent, safety = policy(lambda o: torch.ones(1)), Safety(constraints=True)
    control = Controller(agent, task, safety=safety, fallback=lambda o: [-0.5])
    active = True
    with caplog.at_level(logging.ERROR):
        assert [control.step(UPRIGHT).tolist() for _ in range(2)] == [[-0.5]] * 2
    assert control.report().reasons == {"constraint": 2}
    assert caplog.text.count("RuntimeError: no") == 1


@pytest.mark.parametrize(
    ("stamp", "fresh"),
    [
        (9.95, True),
        (10.04, True),
        (9.8, False),
        (10.06, False),
        (1e9, False),
        (float("nan"), False),
    ],
)
def test_a_sample_of_another_clock_is_stale(stamp, fresh):
    """The pendulum's time step is 0.05 s."""
    control = Controller(policy(still), PENDULUM, safety=Safety(max_age=0.1), clock=lambda: 10.0)
    control.step(UPRIGHT, timestamp=stamp)
    assert control.report().reasons == ({} if fresh else {"stale": 1})


@pytest.mark.parametrize("stamp", [datetime(2026, 1, 1), "10.0", [10.0], True, 10**400])
def test_a_timestamp_is_compared_where_no_age_is_limited_and_else_a_number(stamp):
    control = Controller(policy(still), PENDULUM)
    for _ in range(2):
        control.step(UPRIGHT, timestamp=stamp)
    assert control.report().reasons == {"stale": 1}
    control = Controller(policy(still), PENDULUM, safety=Safety(max_age=0.1), clock=lambda: 10.0)
    with pytest.raises(ValueError, match=r"^timestamp: expected seconds, got "):
        control.step(UPRIGHT, timestamp=stamp)
    assert control.report().steps == 0


@pytest.mark.parametrize("stamp", [np.float64(9.95), np.float32(9.95), torch.tensor(9.95), 10])
def test_seconds_of_numpy_and_torch_are_seconds(stamp):
    control = Controller(policy(still), PENDULUM, safety=Safety(max_age=0.1), clock=lambda: 10.0)
    control.step(UPRIGHT, timestamp=stamp)
    assert control.report().reasons == {}


def test_unknown_keys_are_refused_before_anything_is_done():
    agent = policy(lambda o, mode: mode, "mode")
    control = Controller(agent, followed())
    with pytest.raises(ValueError, match=r"^refrence: .* some of \['mode', 'reference'\]"):
        control.step([0.0, 0.0], refrence=[0.5], mode=[1.0])
    assert control.report().steps == 0
    assert control.step([0.0, 0.0], reference=[0.5], mode=[1.0]).tolist() == [1.0]
    with pytest.raises(ValueError, match=r"^reference: .* expected none"):
        Controller(policy(still), PENDULUM).step(UPRIGHT, reference=[0.5])


def test_what_an_agent_reads_of_its_own_task_and_actor_is_known():
    actor = policy(lambda o, mode: o[:1] + mode, "mode")
    agent = Agent(followed(Mass()), actor=actor)
    control = Controller(agent, replace(followed(Mass()), name="other"))
    given = {"reference": [0.5], "inputs": [1.0], "mode": [0.25]}
    assert control.step([0.0, 0.0], **given).tolist() == [0.25]


@pytest.mark.parametrize("value", [None, "0.5", [None], {}])
def test_a_reference_that_is_no_number_is_refused_with_its_shape(value):
    task = followed(reference=replace(AIM, preview=2))
    with pytest.raises(
        ValueError, match=r"^reference: expected \('x',\) of shape \[1\] or \[3, 1\]"
    ):
        Controller(policy(still), task).step([0.0, 0.0], reference=value)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("max_change", "1"),
        ("max_change", (1.0, "1")),
        ("max_change", float("nan")),
        ("deadline", "0.1"),
        ("mismatch", [0.1]),
        ("max_age", "1"),
        ("hold_steps", 2.5),
        ("constraints", "no"),
        ("plausible", 2.0),
        ("plausible", {"theta_dot": "9"}),
        ("plausible", {"theta_dot": (1.0, 2.0, 3.0)}),
    ],
)
def test_limits_that_are_no_numbers_are_named(key, value):
    with pytest.raises(ConfigError, match=rf"^{key}\S*: expected .*, got"):
        Safety(**{key: value})


def test_limits_may_be_open_at_one_end():
    safety = Safety(plausible={"theta_dot": (-float("inf"), 2.0)})
    control = Controller(policy(still), PENDULUM, safety=safety)
    control.step([1.0, 0.0, -50.0])
    assert control.report().reasons == {}


@pytest.mark.parametrize(
    ("key", "make"),
    [
        ("accept", lambda: Controller(policy(still), PENDULUM, accept=True)),
        ("clock", lambda: Controller(policy(still), PENDULUM, clock=3.0)),
        ("calls", lambda: Controller(policy(still), PENDULUM).warm_up(-1)),
        ("smoothing", lambda: VelocityObserver(PENDULUM, smoothing="0.5")),
        ("most_missing", lambda: VelocityObserver(PENDULUM, most_missing="5")),
    ],
)
def test_what_is_no_function_or_number_is_named(key, make):
    with pytest.raises(ConfigError, match=f"^{key}: expected .*, got"):
        make()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "value",
    [None, [10**400, 0, 0], np.array([1j, 0, 0]), torch.zeros(3) + 1j, np.array(["1", "0", "0"])],
)
def test_an_observation_that_is_no_number_is_refused(value):
    with pytest.raises(ValueError, match=r"^observation: expected numbers, got "):
        Controller(Agent(PENDULUM, actor=Actor(PENDULUM))).step(value)


REVERSED = np.array([0.25, 0.0, 1.0])[::-1]


@pytest.mark.parametrize("value", [REVERSED, REVERSED.astype(">f4"), [10**20, 0.0, 0.25]])
def test_any_array_and_any_size_of_numbers_are_read(value):
    expected = torch.tensor([float(each) for each in value])
    assert as_numbers("observation", value).equal(expected)
    assert as_numbers("observation", np.zeros(1)[::-1]).tolist() == [0.0]


@pytest.mark.parametrize("number", [np.int64, torch.tensor])
def test_numbers_of_numpy_and_torch_are_numbers(number):
    control = Controller(policy(still), PENDULUM)
    assert set(control.warm_up(number(2))) == {"p50_ms", "p99_ms"}
    half = np.float32(0.5) if number is np.int64 else torch.tensor(0.5)
    observer = VelocityObserver(PENDULUM, smoothing=half, most_missing=number(3))
    assert observer.most_missing == 3


@pytest.mark.parametrize(("deadline", "warned"), [(None, False), (0.02, False), (15.0, True)])
def test_a_deadline_of_more_than_a_step_is_warned_of(caplog, deadline, warned) -> None:
    task = get_task("pendulum")
    Controller(Agent(task, actor=Actor(task)), safety=Safety(deadline=deadline))
    assert ("deadline: 15 s is more than the time step" in caplog.text) == warned
