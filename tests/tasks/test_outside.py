"""References, inputs and disturbances in a task: its state, its step, its reward, its errors."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import Signal, get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import DynamicsLoss, HybridDynamics, TaskWorldModel
from phihp_torchrl.tasks import Actuator, Disturbance
from tests.followed import AIM, WIND, Mass, disturbed, followed, squared

EVERYTHING = {
    "reference": replace(AIM, preview=2),
    "disturbance": Disturbance(high={"x_dot": 3.0}),
    "actuator": Actuator(delay_steps=1.0),
}


def model_of(task):
    return TaskWorldModel(task, HybridDynamics.pure_prior(task))


def test_registers_stand_behind_the_state_and_signals_come_first():
    task = followed(Mass(), **EVERYTHING)
    assert [part.name for part in task.registers.parts] == [
        "inputs",
        "reference",
        "disturbance",
        "actuator",
    ]
    assert (task.state_dim, task.shown_dim, task.observation_dim) == (2 + 6, 2 + 4, 2 + 6)
    state = task.sample_start([50], torch.Generator().manual_seed(0))
    assert torch.allclose(task.locate(task.observe(state)), state, atol=1e-6)
    shown = task.observe(state)[:, : task.shown_dim]
    assert torch.allclose(task.complete(shown, task.split(state)[1]), task.observe(state))


def test_an_episode_starts_with_signals_drawn_and_nothing_else_under_way():
    task = followed(Mass(), **EVERYTHING)
    state = task.sample_start([200], torch.Generator().manual_seed(0))
    wind, reference, others = state[:, 2:3], state[:, 3:6], state[:, 6:]
    assert wind.std() > 0.5
    assert reference.std() > 0.3
    assert others.eq(0).all()


def test_a_reference_stays_or_moves_up_to_what_is_known():
    task = followed(reference=replace(AIM, preview=2))
    state = torch.tensor([0.0, 0.0, 0.1, 0.2, 0.3])
    after = model_of(task).transition(state, torch.zeros(1)).next_state
    assert torch.allclose(after[2:], torch.tensor([0.2, 0.3, 0.3]))


def test_the_reward_sees_the_reference_at_the_end_of_the_step():
    def still(state, action):
        return state

    state = torch.tensor([0.5, 0.0, 0.0, 0.25])
    previewed = followed(reference=replace(AIM, preview=1))
    assert previewed.transition(still, state, torch.zeros(1)).reward.item() == -(0.25**2)
    # Without preview, what was known at its start.
    assert followed().transition(still, state[:3], torch.zeros(1)).reward.item() == -(0.5**2)


def test_an_end_may_see_the_reference_too():
    def lost(next_state, reference):
        return (next_state[..., 0] - reference[..., 0]).abs() > 1.0

    task = followed(terminated=lost)
    assert task.is_terminated(torch.tensor([[0.5, 0.0, -0.6], [0.5, 0.0, 0.6]])).tolist() == [
        True,
        False,
    ]


def test_inputs_act_beside_the_command():
    task = followed(Mass())
    state = torch.tensor([0.0, 0.0, 1.5, 0.0])
    after = model_of(task).transition(state, torch.tensor([9.0])).next_state
    assert after[1].item() == pytest.approx(0.1 * (5.0 + 1.5))  # the command is clipped to 5
    assert after[2].item() == 1.5


def test_a_model_is_fitted_with_the_inputs_that_acted():
    task = followed(Mass())
    generator = torch.Generator().manual_seed(0)
    world = TaskWorldModel(task, HybridDynamics.pure_prior(task, constants={"mass": 2.0}))
    state = task.sample_start([64], generator)
    action = 2.0 * torch.rand([64, 1], generator=generator) - 1.0
    following = world.transition(state, action).next_state
    shown = {"observation": task.observe(state), "action": action}
    data = TensorDict(
        **shown, next=TensorDict(observation=task.observe(following)), batch_size=[64]
    )
    right = DynamicsLoss(world.transitions)(data)["loss_prediction"]
    wrong = DynamicsLoss(HybridDynamics.pure_prior(task))(data)["loss_prediction"]
    assert right < 1e-10
    assert wrong > 1e-4


def test_a_disturbance_moves_the_model_and_lasts():
    task = disturbed()
    state = torch.tensor([0.0, 0.0, 0.0, 2.0])
    after = model_of(task).transition(state, torch.zeros(1)).next_state
    assert after[1].item() == pytest.approx(0.1 * 2.0)
    assert after[3].item() == 2.0


def test_the_six_tasks_have_nothing_from_outside():
    for name in ("pendulum", "cartpole-swingup", "acrobot"):
        assert not get_task(name).outside
        assert get_task(name).register_count == 0


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"reward": lambda state, action, next_state: 0.0}, "reward"),
        ({"reference": None}, "reference"),
        ({"inputs": WIND}, "inputs"),
        ({"system": Mass(), "inputs": None}, "inputs"),
        ({"system": Mass(), "inputs": Signal(("rain",), (0.0,), (1.0,))}, "inputs"),
        ({"disturbance": Disturbance(high={"y": 1.0})}, "disturbance.high"),
    ],
)
def test_what_does_not_fit_together_is_refused_by_name(changes, key):
    with pytest.raises(ConfigError, match=f"^{key}: "):
        followed(**changes)


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"high": {}}, "high"),
        ({"high": {"x": -1.0}}, "high.x"),
        ({"high": {"x": 1.0}, "time": 0.0}, "time"),
    ],
)
def test_wrong_numbers_of_a_disturbance_are_refused_by_name(settings, key):
    with pytest.raises(ConfigError, match=f"^{key}: "):
        Disturbance(**settings)


def test_an_exploration_reward_may_leave_the_reference_out():
    task = followed(exploration_reward=lambda state, action, next_state: next_state[..., 1].abs())
    swapped = replace(task, reward=task.exploration_reward, exploration_reward=squared)
    state = task.sample_start([3])
    assert model_of(swapped).transition(state, torch.zeros(3, 1)).reward.shape == (3,)
