"""Every row of the published table, and what holds for each task in it."""

from __future__ import annotations

import math

import pytest
import torch

from phihp_torchrl import get_task
from phihp_torchrl.systems import Acrobot, CartPole, ElbowAcrobot, Pendulum
from phihp_torchrl.tasks import list_tasks
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

PI = math.pi
INF = math.inf
HANGING_POLE = ((-0.05, -0.05, PI - 0.05, -0.05), (0.05, 0.05, PI + 0.05, 0.05))
# name: system, action bounds, seconds, steps, ends early, reset box, velocity limits
TABLE = {
    "pendulum": (Pendulum, (2,), 0.05, 200, False, ((-PI, -1), (PI, 1)), (INF,)),
    "pendulum-swingup": (
        *(Pendulum, (2,), 0.05, 500, False),
        *(((PI - PI / 32, -1), (PI + PI / 32, 1)), (INF,)),
    ),
    "cartpole": (CartPole, (10,), 0.02, 500, True, ((-0.05,) * 4, (0.05,) * 4), (INF, INF)),
    "cartpole-swingup": (CartPole, (10,), 0.02, 500, False, HANGING_POLE, (INF, INF)),
    "cartpole-swingup-published": (CartPole, (10,), 0.02, 500, False, HANGING_POLE, (INF, INF)),
    "acrobot": (
        *(ElbowAcrobot, (1,), 0.2, 500, True),
        *(((-0.1,) * 4, (0.1,) * 4), (4 * PI, 9 * PI)),
    ),
    "acrobot-swingup": (
        *(Acrobot, (1, 1), 0.2, 500, False),
        *(((-0.1,) * 4, (0.1,) * 4), (4 * PI, 9 * PI)),
    ),
}
all_tasks = pytest.mark.parametrize("name", list(TABLE))


def test_the_seven_tasks_are_registered():
    assert set(TABLE) <= set(list_tasks())


@all_tasks
def test_rows_of_the_published_table(name):
    system, action_high, time_step, steps, ends_early, (low, high), limits = TABLE[name]
    task = get_task(name)
    assert type(task.system) is system
    assert task.action_high == action_high
    assert task.action_low == tuple(-value for value in action_high)
    assert task.time_step == time_step
    assert task.max_steps == steps
    assert (task.terminated is not None) == ends_early
    assert task.reset.low == pytest.approx(low)
    assert task.reset.high == pytest.approx(high)
    assert [value for value, _ in task.layout.limits] == pytest.approx([-x for x in limits])
    assert [value for _, value in task.layout.limits] == pytest.approx(limits)


@all_tasks
def test_resets_fill_their_box_and_lie_in_the_coverage(name):
    task = get_task(name)
    states = task.reset.sample([4096], generator=torch.Generator().manual_seed(0))
    low, high = torch.tensor(task.reset.low), torch.tensor(task.reset.high)
    assert ((states >= low) & (states <= high)).all()
    width = (high - low).clamp_min(1e-6)
    assert ((states.amin(0) - low) / width < 0.01).all()
    assert ((high - states.amax(0)) / width < 0.01).all()
    torch.testing.assert_close(states.mean(0), (low + high) / 2, rtol=0, atol=0.03 * width.max())
    # The coverage is a box too; on the circle it must contain the resets.
    zero = torch.zeros_like(states)
    on_circle = task.system.difference(states, zero)
    edge = torch.tensor(task.coverage.high) + 1e-5
    assert (on_circle.abs() <= edge).all()


@all_tasks
def test_tasks_that_do_not_end_early_never_end(name):
    task = get_task(name)
    wild = 100 * torch.randn(2, 500, task.state_dim)
    ended = task.is_terminated(wild)
    assert ended.shape == (2, 500)
    assert ended.dtype == torch.bool
    assert ended.any() == TABLE[name][4]


@all_tasks
def test_full_turns_change_neither_reward_nor_end(name):
    task = get_task(name)
    generator = torch.Generator().manual_seed(0)
    state = task.coverage.sample([256], generator=generator, dtype=torch.float64)
    turned = state.clone()
    if name != "cartpole":  # a pole that went round has fallen
        turned[:, list(task.system.angle_indices)] += 2 * PI
    action = torch.ones(256, task.action_dim, dtype=torch.float64)
    torch.testing.assert_close(
        task.reward(state, action, state), task.reward(turned, action, turned)
    )
    assert torch.equal(task.is_terminated(state), task.is_terminated(turned))


@all_tasks
def test_a_step_is_semi_implicit_euler_on_the_true_world(name):
    task = get_task(name)
    world = SimulatedWorld(task)
    state = task.coverage.sample([32], dtype=torch.float64)
    action = torch.tensor([task.action_high], dtype=torch.float64).expand(32, -1)
    new = world.step(state, action)
    rate = world.truth.derivative(state, action)
    positions = [task.system.state_names.index(q) for q in task.system.velocity_of]
    speeds = list(task.system.velocity_indices)
    limit = torch.tensor(TABLE[name][6], dtype=torch.float64)
    expected = (state[:, speeds] + task.time_step * rate[:, speeds]).clamp(-limit, limit)
    torch.testing.assert_close(new[:, speeds], expected)
    torch.testing.assert_close(new[:, positions], state[:, positions] + task.time_step * expected)


@all_tasks
def test_the_integrator_is_a_choice_of_the_world(name):
    task = get_task(name)
    state = task.reset.sample([4], dtype=torch.float64)
    action = torch.zeros(4, task.action_dim, dtype=torch.float64)
    euler, rk4, dopri5 = (
        SimulatedWorld(task, SimulatedConfig(integrator=name)).step(state, action)
        for name in ("semi_implicit_euler", "rk4", "dopri5")
    )
    torch.testing.assert_close(rk4, dopri5, rtol=1e-3, atol=1e-3)
    assert not torch.equal(euler, rk4)
    assert torch.equal(SimulatedWorld(task).step(state, action), euler)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@all_tasks
def test_any_leading_batch_dimensions_and_dtype(name, batch):
    task = get_task(name)
    world = SimulatedWorld(task)
    for dtype in (torch.float32, torch.float64):
        state = task.reset.sample(list(batch), dtype=dtype)
        action = torch.zeros(*batch, task.action_dim, dtype=dtype)
        new, reward, ended = task.transition(world.step, state, action)
        assert (new.shape, new.dtype) == (state.shape, dtype)
        assert (reward.shape, reward.dtype) == (batch, dtype)
        assert (ended.shape, ended.dtype) == (batch, torch.bool)
        exploration = (task.exploration_reward or task.reward)(state, action, new)
        assert (exploration.shape, exploration.dtype) == (batch, dtype)
