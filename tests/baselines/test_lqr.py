"""The regulator: gains known from theory, dead time, weights, and what cannot be stabilised."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import ConfigError, HybridDynamics, get_task
from phihp_torchrl.baselines import LQR
from phihp_torchrl.tasks import Actuator, Disturbance

from .parts import Slider, Stray, Tank, play, prior_of, task_of


def test_the_gain_of_a_scalar_system_is_that_of_its_quadratic_equation() -> None:
    task = task_of(Tank())
    lqr = LQR.from_model(task, prior_of(task), state_weights=[1.0], action_weights=[0.5])
    a, b = 1.0 - 0.1 * 0.5, 0.1 * 2.0  # one step of Euler
    # p = 1 + a² p - a² b² p² / (r + b² p), solved for its positive root.
    r, q = 0.5, 1.0
    linear = r * (1.0 - a * a) - q * b * b
    p = (-linear + math.sqrt(linear**2 + 4.0 * b * b * q * r)) / (2.0 * b * b)
    assert lqr.gain.item() == pytest.approx(a * b * p / (r + b * b * p), rel=1e-9)
    assert lqr.cost.item() == pytest.approx(p, rel=1e-9)


def test_without_other_weights_those_of_the_reward_count() -> None:
    task = task_of(Slider())
    dynamics = prior_of(task)
    ours = LQR.from_model(task, dynamics)
    # A reward of -(x² + v² + u²/2) in half-ranges 1, 1, 5: 2, 2 and 25; 1 % and 10 % of 25 on top.
    told = LQR.from_model(
        task,
        dynamics,
        state_weights=[2 / 25 + 0.01] * 2,
        action_weights=[(1 + 0.1) / 25],
    )
    np.testing.assert_allclose(ours.gain, told.gain, rtol=1e-9)
    assert ours.unit == pytest.approx(25.0)


@pytest.mark.parametrize("shape", [(), (3,), (2, 4)])
def test_it_stabilises_and_the_cost_to_go_is_the_cost(shape: tuple[int, ...]) -> None:
    task = task_of(Slider())
    lqr = LQR.from_model(task, prior_of(task), state_weights=[1, 0.2], action_weights=[0.1])
    start = torch.tensor([0.3, -0.1]).expand(*shape, 2)
    states = play(lqr, task, start, 120)
    assert states.shape == (121, *shape, 2)
    assert states[-1].abs().max() < 1e-3
    actions = lqr.act(states)
    paid = (states.square() @ torch.tensor([1.0, 0.2]) + 0.1 * actions[..., 0] ** 2).sum(0)
    torch.testing.assert_close(paid, lqr.value(start), rtol=1e-3, atol=1e-4)


def test_it_reckons_with_dead_time() -> None:
    late = task_of(Slider(), Actuator(delay_steps=3.0))
    weights = {"state_weights": [1.0, 0.0], "action_weights": [0.01]}
    dynamics = prior_of(late)
    knows = LQR.from_model(late, dynamics, **weights)
    prompt = replace(late, actuator=None)
    blind = LQR.from_model(prompt, prior_of(prompt), **weights)
    blind = LQR(replace(blind.point, task=late), blind.gain.numpy(), blind.cost.numpy())
    start = late.at_rest(torch.tensor([0.1, 0.0]))
    ends = [play(each, late, start, 150, dynamics)[-1, :2].norm() for each in (knows, blind)]
    assert ends[0] < 1e-3 < 0.02 < ends[1]  # the blind one keeps oscillating


def test_it_reckons_with_dead_time_beside_an_estimated_disturbance() -> None:
    late = task_of(Slider(), Actuator(delay_steps=3.0))
    disturbed = replace(late, disturbance=Disturbance(high={"x_dot": 1.0}), action_rate_cost=0.1)
    dynamics = prior_of(late)
    lqr = LQR.from_model(disturbed, dynamics)
    alone = LQR.from_model(replace(late, action_rate_cost=0.1), dynamics)
    np.testing.assert_allclose(lqr.gain, alone.gain, rtol=1e-9)
    state = disturbed.at_rest(torch.tensor([[0.1, 0.0]]))
    state[:, 2] = 0.7  # the estimate, which it has no use for
    state[:, 3:6] = torch.tensor([1.0, 2.0, 3.0])
    own = torch.cat([state[:, :2], state[:, 3:]], -1)
    torch.testing.assert_close(lqr.act(state), alone.act(own))


def test_where_a_small_command_does_nothing_it_takes_the_physical_part() -> None:
    stuck = task_of(Slider(), Actuator(delay_steps=1.0, dead_zone=0.1))
    assert LQR.from_model(stuck, prior_of(stuck)).gain.shape == (1, 2)


def test_it_stays_at_a_goal_that_needs_an_action() -> None:
    task = task_of(Tank())
    lqr = LQR.from_model(task, prior_of(task), goal=[0.8])
    states = play(lqr, task, torch.tensor([-0.5]), 200)
    assert states[-1].item() == pytest.approx(0.8, abs=1e-4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"goal": [0.0]}, r"goal: expected 2 values for \('x', 'x_dot'\), got \(0.0,\)"),
        ({"goal": [0.0, 0.9]}, "goal: expected a state to stay in: the model drifts from"),
        ({"state_weights": [1.0, -1.0]}, "state_weights: expected 2 numbers at least 0"),
        ({"action_weights": [0.0]}, "action_weights: expected 1 numbers above 0"),
    ],
)
def test_wrong_arguments_are_named(options: dict, words: str) -> None:
    task = task_of(Slider())
    with pytest.raises(ConfigError, match=words):
        LQR.from_model(task, prior_of(task), **options)


def test_what_the_action_does_not_reach_is_named() -> None:
    task = task_of(Stray())
    with pytest.raises(ConfigError, match=r"force does not reach the mode of drift \(modulus 1.03"):
        LQR.from_model(task, prior_of(task), goal=[0.0, 0.0, 0.0])


def test_a_task_that_pays_most_elsewhere_has_no_goal() -> None:
    task = get_task("acrobot")
    with pytest.raises(ConfigError, match=r"goal: .* other states earn more than"):
        LQR.from_model(task, HybridDynamics.pure_prior(task))


def test_observations_of_another_size_are_refused() -> None:
    task = task_of(Slider(), Actuator(delay_steps=1.0))
    lqr = LQR.from_model(task, prior_of(task))
    with pytest.raises(ValueError, match=r"expected 3 components at the end, got one of shape \[2"):
        lqr(TensorDict(observation=torch.zeros(2)))
    with pytest.raises(ValueError, match="observation: expected 3 components at the end, got none"):
        lqr(TensorDict())


def test_friction_that_is_steep_at_rest_does_not_pass_for_a_viscous_one() -> None:
    class Rubbed(torch.nn.Module):
        def forward(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
            rub = 1e-3 * (state[..., 1:] / 1e-5).tanh()  # m/s in a step, whose slope at 0 is 100
            return clean(state, action) - torch.cat([torch.zeros_like(rub), rub], -1)

    task = task_of(Slider())
    clean = prior_of(task).double()
    weights = {"state_weights": [1.0, 0.2], "action_weights": [0.1]}
    ours = LQR.from_model(task, Rubbed(), **weights)
    free = LQR.from_model(task, clean, **weights)
    np.testing.assert_allclose(ours.gain, free.gain, rtol=0.2)
