"""Velocities that no sensor measures: found, and without lag where there is a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from phihp_torchrl import Agent, HybridDynamics, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import Controller, VelocityObserver
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.worlds import SimulatedWorld
from tests.followed import Mass, followed


def follow(observer, task, noise=0.0, steps=200):
    """Errors of the velocities along a path of changing commands, ``[steps, velocities]``."""
    oracle = SimulatedWorld(replace(task, actuator=None)).oracle()
    generator = torch.Generator().manual_seed(0)
    state, registers = task.system.locate(task.system.observe(torch.tensor([3.0, 0.0]))), None
    registers, errors = task.rest(state), []
    for k in range(steps):
        measured = torch.tensor([state[0], torch.nan])
        measured[0] += noise * torch.randn((), generator=generator)
        errors.append(observer.update(measured)[1] - state[1])
        action = torch.tensor([2.0 if k // 10 % 2 else -2.0])
        observer.acted(action)
        acting, registers = task.acting(registers, action)
        with torch.no_grad():
            state = oracle.step(state, acting)
    return torch.stack(errors)


@pytest.mark.parametrize("actuator", [None, Actuator(delay_steps=2.0, lag=0.05)])
def test_with_the_true_model_the_velocity_is_exact(actuator):
    task = replace(get_task("pendulum"), actuator=actuator)
    oracle = SimulatedWorld(get_task("pendulum")).oracle()
    assert follow(VelocityObserver(task, oracle), task).abs().max() < 1e-3


def test_a_model_beats_none_and_smoothing_beats_differences_where_noise_is_large():
    task = get_task("pendulum")
    oracle = SimulatedWorld(task).oracle()
    rms = [
        follow(VelocityObserver(task, model, smoothing=p), task, noise=0.03)[20:].square().mean()
        for model, p in ((None, 0.0), (None, None), (oracle, None))
    ]
    assert rms[2] < 0.3 * rms[1]
    assert rms[1] < rms[0]


def test_a_turn_of_the_angle_is_no_jump():
    observer = VelocityObserver(get_task("pendulum"))
    for angle in torch.arange(2.9, 3.6, 0.05):
        turned = (angle + torch.pi) % (2 * torch.pi) - torch.pi
        state = observer.update(torch.tensor([turned, torch.nan]))
        observer.acted(torch.zeros(1))
    assert state[1].item() == pytest.approx(1.0, abs=0.05)


def test_lost_samples_are_predicted_for_a_while():
    task = get_task("pendulum")
    control = Controller(
        Agent(task, actor=Actor(task)),
        observer=VelocityObserver(task, most_missing=2),
        fallback="zero",
    )
    control.step([0.1, np.nan])
    for _ in range(4):
        control.step([np.nan, np.nan])
    assert control.report().reasons == {"observation": 2}
    control.step([0.1, np.nan])
    assert control.report().reasons == {"observation": 2}


def test_what_is_measured_stays():
    observer = VelocityObserver(get_task("pendulum"))
    observer.update(torch.tensor([0.0, 1.0]))
    observer.acted(torch.zeros(1))
    assert observer.update(torch.tensor([0.3, 2.0]))[1] == 2.0


def test_smoothing_out_of_range():
    with pytest.raises(ValueError, match=r"^smoothing: expected"):
        VelocityObserver(get_task("pendulum"), smoothing=1.0)


@pytest.mark.parametrize("through", ["observer", "controller"])
def test_the_model_predicts_with_the_inputs_that_were_measured(through):
    """A mass in a wind of 1 to 2 N; the middle of the wind's range is 0."""
    task = followed(Mass())
    model = HybridDynamics.pure_prior(task)
    observer = VelocityObserver(task, model, smoothing=0.5)
    control = Controller(Agent(task, actor=Actor(task)), observer=observer)
    state = torch.zeros(2)
    for k in range(20):
        wind, measured = torch.tensor([1.0 + k % 2]), torch.tensor([state[0], torch.nan])
        if through == "observer":
            found, action = observer.update(measured, wind), torch.zeros(1)
            observer.acted(action)
        else:
            action = torch.tensor(control.step(measured, reference=[0.0], inputs=wind))
            found = observer._state
        assert torch.allclose(found, state, atol=1e-4)
        with torch.no_grad():
            state = model.step(state, torch.cat([action, wind]))


def test_inputs_that_are_not_given_stay_and_wrong_ones_are_named():
    task = followed(Mass())
    observer = VelocityObserver(task, HybridDynamics.pure_prior(task))
    observer.update(torch.zeros(2), torch.tensor([2.0]))
    for speed in (0.2, 0.4):  # 2 N on 1 kg for 0.1 s each
        observer.acted(torch.zeros(1))
        assert observer.update(torch.full((2,), torch.nan))[1].item() == pytest.approx(speed)
    with pytest.raises(ValueError, match=r"^inputs: expected \('wind',\) of shape \[1\]"):
        observer.update(torch.zeros(2), torch.zeros(2))


def test_an_input_that_is_lost_leaves_the_last_one_to_the_observer():
    task = followed(Mass())
    observer = VelocityObserver(task, HybridDynamics.pure_prior(task))
    control = Controller(Agent(task, actor=Actor(task)), observer=observer, fallback="zero")
    control.step([0.0, 0.0], reference=[0.0], inputs=[2.0])
    control.step([0.0, 0.0], inputs=[np.nan])
    control.step([np.nan, np.nan])
    assert control.report().reasons == {"inputs": 1}
    assert observer._state[1].item() == pytest.approx(0.2)
