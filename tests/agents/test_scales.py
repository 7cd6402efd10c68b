"""The units of networks: what is measured, what is left alone, and that folding changes nothing."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from phihp_torchrl import Box, HybridDynamics, System, Task, get_task
from phihp_torchrl.agents import (
    Actor,
    Scales,
    TwinQ,
    copy_actor,
    copy_twin_qvalue,
    measure_scales,
    scaled,
    visited_states,
)
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import StartConfig, make_start_states
from phihp_torchrl.worlds import SimulatedWorld

PENDULUM = get_task("pendulum")
PAPER = (
    "pendulum",
    "pendulum-swingup",
    "cartpole",
    "cartpole-swingup",
    "cartpole-swingup-published",
    "acrobot",
    "acrobot-swingup",
)


class Slider(System):
    """A mass on a rail."""

    state_names, action_names = ("x", "x_dot"), ("force",)
    velocity_of = {"x": "x_dot"}

    def prior(self, state, action, constants):
        return torch.stack([state[..., 1], action[..., 0] + 0 * state[..., 0]], -1)


def slider(coverage, reward=1.0):
    return Task(
        name="slider",
        system=Slider(),
        action_high=(1.0,),
        time_step=0.1,
        max_steps=100,
        reset=Box.around((0.0, 0.0), (0.1, 0.1)),
        reward=lambda state, action, next_state: torch.full_like(state[..., 0], reward),
        coverage=coverage,
    )


def model_of(task):
    return TaskWorldModel(task, HybridDynamics.pure_prior(task))


def measured(task, horizon=100.0):
    model, generator = model_of(task), torch.Generator().manual_seed(0)
    states = visited_states(model, make_start_states(task), 50, generator)
    return measure_scales(model, states, horizon, generator)


@pytest.mark.parametrize("name", PAPER)
@pytest.mark.parametrize("gamma", [0.99, 0.995])
def test_the_tasks_of_the_paper_stay_as_they_are(name, gamma):
    task = get_task(name)
    model = SimulatedWorld(task).model()
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        states = visited_states(model, make_start_states(task), 200, generator)
        scales = measure_scales(model, states, 1 / (1 - gamma), generator)
        assert scales.are_one, scales
    assert scaled(model, scales) is model


@given(st.sampled_from([1e-4, 0.07, 1.0, 30.0, 4000.0]), st.sampled_from([1e-3, 1.0, 1e6]))
@settings(deadline=None)
def test_what_networks_read_is_of_the_size_of_one(unit, reward):
    scales = measured(slider(Box.around((0.0, 0.0), (unit, 3 * unit)), reward))
    half = torch.tensor([unit, 3 * unit]) / scales.scale
    assert ((half > 0.24) & (half < 17)).all()
    assert (scales.center == 0).all()
    assert 0.9 <= 100 * reward / scales.reward <= 2049
    assert (scales.scale.log2() % 1 == 0).all(), "powers of two, which round nothing"


def test_what_is_far_from_zero_is_centred():
    scales = measured(slider(Box((290.0, -1.0), (310.0, 1.0))))
    assert abs(300 - scales.center[0]) <= 8
    assert scales.center[1] == 0
    assert scales.scale[0] == 8


def test_what_does_not_vary_and_angles_are_left_alone():
    assert measured(slider(Box((5.0, 0.0), (5.0, 0.0)))).are_one
    narrow = replace(PENDULUM, coverage=Box.around((0.0, 0.0), (0.001, 1.0)))
    assert measured(narrow, horizon=1e4).scale.tolist() == [1.0, 1.0, 1.0]


def test_a_task_without_coverage_is_explored():
    task = slider(None)
    states = visited_states(model_of(task), make_start_states(task), 50)
    assert states.isfinite().all()
    assert states[:, 0].abs().max() > 1, "much farther than the reset box"


def test_states_that_are_not_finite_are_left_out():
    task = slider(None)
    states = torch.tensor([[100.0, 0.0], [-100.0, 0.0], [torch.nan, 0.0], [torch.inf, 0.0]])
    assert measure_scales(model_of(task), states, 100.0).scale[0] == 128


@given(
    st.lists(st.sampled_from([2.0**-9, 1.0, 2.0**10]), min_size=3, max_size=3),
    st.sampled_from([0.0, -3.0, 20.0]),
    st.sampled_from([2.0**-10, 1.0, 2.0**13]),
)
@settings(deadline=None, max_examples=30)
def test_folded_networks_are_the_trained_ones_in_physical_units(scale, centers, reward):
    scale = torch.tensor(scale)
    scales = Scales(centers * scale, scale, reward)
    unit, action = torch.randn(16, 3), torch.randn(16, 1)
    observation = scales.center + scale * unit
    actor = Actor(PENDULUM, (8, 8))
    layers = [layer.detach() for layer in actor.mlp.parameters()]
    folded = copy_actor(PENDULUM, scales.actor(layers)).module
    torch.testing.assert_close(folded(observation), actor(unit), rtol=1e-3, atol=1e-4)
    critics = TwinQ(PENDULUM, (8, 8))
    layers = [layer.detach() for layer in critics.layers]
    folded = copy_twin_qvalue(PENDULUM, scales.critics(layers)).module
    values = folded(observation, action) / reward
    torch.testing.assert_close(values, critics(unit, action), rtol=1e-3, atol=1e-4)


def test_units_of_one_are_folded_to_the_bit():
    layers = [layer.detach() for layer in TwinQ(PENDULUM, (8,)).layers]
    folded = Scales(torch.zeros(3), torch.ones(3)).critics(layers)
    assert all(torch.equal(a, b) for a, b in zip(folded, layers, strict=True))


def test_a_scaled_model_differs_in_observations_and_rewards_alone():
    model = model_of(PENDULUM)
    scales = Scales(torch.tensor([0.0, 0.0, 4.0]), torch.tensor([1.0, 1.0, 8.0]), 16.0)
    small = scaled(model, scales)
    state, action = PENDULUM.coverage.sample([10]), torch.ones(10, 1)
    observation = model.observe(state)
    assert torch.equal(small.observe(state), (observation - scales.center) / scales.scale)
    torch.testing.assert_close(small.locate(small.observe(state)), state)
    ours, theirs = small.transition(state, action), model.transition(state, action)
    assert torch.equal(ours.next_state, theirs.next_state)
    assert torch.equal(ours.reward, theirs.reward / 16)


def test_coverage_is_asked_whatever_the_shares_of_start_states():
    task = slider(Box.around((0.0, 0.0), (4000.0, 1.0)))
    starts = make_start_states(task, StartConfig(reset=1.0, coverage=0.0, goal=0.0))
    assert visited_states(model_of(task), starts, 10)[:, 0].abs().max() > 3000
