"""Velocities that no sensor measures: found, and without lag where there is a model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from phihp_torchrl import Agent, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import Controller, VelocityObserver
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.worlds import SimulatedWorld


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
