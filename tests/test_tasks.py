"""Tasks: every row of the published table, with rewards and terminations computed by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from phihp_torchrl import Task, get_task, register_task
from phihp_torchrl.systems import Acrobot, CartPole, ElbowAcrobot, Pendulum
from phihp_torchrl.tasks import Box, list_tasks

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


def rewards(name, states, actions, next_states):
    """Rewards as floats, of nested lists, in float64."""
    tensors = (torch.tensor(x, dtype=torch.float64) for x in (states, actions, next_states))
    return get_task(name).reward(*tensors).tolist()


def ends(name, *next_states):
    return get_task(name).is_terminated(torch.tensor(next_states, dtype=torch.float64)).tolist()


def test_the_seven_tasks_are_registered():
    assert set(TABLE) <= set(list_tasks())


@all_tasks
def test_rows_of_the_published_table(name):
    system, action_high, time_step, steps, ends_early, (low, high), limits = TABLE[name]
    task = get_task(name)
    assert type(task.system) is system
    assert task.action_high == action_high
    assert task.time_step == time_step
    assert task.max_steps == steps
    assert (task.terminated is not None) == ends_early
    assert task.reset.low == pytest.approx(low)
    assert task.reset.high == pytest.approx(high)
    assert task.layout.limits == pytest.approx(limits)
    assert task.integrator == "semi_implicit_euler"
    camel = "".join(part.capitalize() for part in name.split("-"))
    camel = camel.replace("Cartpole", "CartPole")
    assert task.env_id == f"phihp/{camel}-v0"


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


@pytest.mark.parametrize("name", ["pendulum", "pendulum-swingup"])
def test_pendulum_reward_is_of_the_state_before_the_step(name):
    state = [[PI / 2 + 2 * PI, 2.0], [0.0, 0.0], [PI, 0.0], [-0.1, -1.0]]
    action = [[1.0], [0.0], [-2.0], [0.5]]
    expected = [
        -(PI**2 / 4 + 0.1 * 4 + 0.001),
        0.0,
        -(PI**2 + 0.001 * 4),
        -(0.01 + 0.1 + 0.001 * 0.25),
    ]
    assert rewards(name, state, action, [[9.0, 9.0]] * 4) == pytest.approx(expected)


def test_cartpole_earns_one_a_step_the_failing_one_included():
    assert rewards("cartpole", [[0.0] * 4] * 2, [[0.0]] * 2, [[0.0] * 4, [9.0] * 4]) == [1.0, 1.0]


def test_cartpole_swingup_reward_is_of_the_tip_after_the_step():
    # l = 0.5: the tip is at (x + sin theta, cos theta), the goal at (0, 1).
    after = [
        [0.0, 9.0, 0.0, 9.0],
        [0.0, 0.0, PI, 0.0],
        [1.0, 0.0, PI / 2, 0.0],
        [-1.0, 0, PI / 2, 0],
    ]
    expected = [1.0, math.exp(-4), math.exp(-5), math.exp(-1)]
    before = [[7.0] * 4] * 4
    assert rewards("cartpole-swingup", before, [[10.0]] * 4, after) == pytest.approx(expected)


def test_published_cartpole_swingup_reward_prefers_the_pole_flat():
    after = [
        [0.0, 9.0, 0.0, 9.0],
        [0.0, 0.0, PI, 0.0],
        [-0.5, 0.0, PI / 2, 0.0],
        [1.0, 0, PI / 2, 0],
    ]
    expected = [math.exp(-0.25), math.exp(-0.25), 1.0, math.exp(-2.25)]
    before = [[7.0] * 4] * 4
    name = "cartpole-swingup-published"
    assert rewards(name, before, [[10.0]] * 4, after) == pytest.approx(expected)


def test_hanging_still_earns_389_of_the_published_reward():
    for name, expected in (
        ("cartpole-swingup-published", 500 * math.exp(-0.25)),
        ("cartpole-swingup", 500 * math.exp(-4)),
    ):
        task = get_task(name)
        state = torch.tensor([0.0, 0.0, PI, 0.0], dtype=torch.float64)
        action = torch.zeros(1, dtype=torch.float64)
        earned = 0.0
        for _ in range(task.max_steps):
            next_state = task.step(state, action)
            earned += task.reward(state, action, next_state).item()
            state = next_state
        # Rounding moves the cart, and dry friction then rattles it by a millimetre a second.
        assert earned == pytest.approx(expected, abs=0.05)
    assert 500 * math.exp(-0.25) == pytest.approx(389, abs=0.5)


def test_acrobot_rewards_are_of_the_state_after_the_step():
    hanging, flat, upright, folded = [0.0] * 4, [PI / 2, 0, 0, 0], [PI, 0, 0, 0], [PI, PI, 0, 0]
    after = [hanging, flat, upright, folded]
    before, idle = [[1.0] * 4] * 4, [[0.0]] * 4
    assert rewards("acrobot", before, idle, after) == [-1, -1, 0, -1]
    both = [[0.0, 0.0]] * 4
    assert rewards("acrobot-swingup", before, both, after) == pytest.approx([-1, 0, 1, 0], abs=1e-9)


def test_cartpole_ends_beyond_the_track_or_twelve_degrees():
    lean = math.radians(12)
    edges = [[2.4, 0, 0, 0], [-2.4, 0, 0, 0], [0, 0, lean, 0], [0, 0, -lean, 0], [0, 99, 0, 99]]
    assert ends("cartpole", *edges) == [False] * 5
    beyond = [[2.4 + 1e-9, 0, 0, 0], [-2.4 - 1e-9, 0, 0, 0], [0, 0, lean + 1e-9, 0]]
    assert ends("cartpole", *beyond, [0, 0, -lean - 1e-9, 0]) == [True] * 4


def test_acrobot_ends_when_its_tip_is_a_link_above_the_hinge():
    # Stretched out, the tip is at -2 cos theta1: above 1 from 120 degrees on.
    limit = 2 * PI / 3
    angles = [limit - 1e-9, limit + 1e-9, -limit + 1e-9, -limit - 1e-9, PI, 0.0]
    expected = [False, True, False, True, True, False]
    assert ends("acrobot", *([angle, 0, 0, 0] for angle in angles)) == expected


@all_tasks
def test_tasks_that_do_not_end_early_never_end(name):
    task = get_task(name)
    wild = 100 * torch.randn(2, 500, task.system.state_dim)
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
    action = torch.ones(256, task.system.action_dim, dtype=torch.float64)
    torch.testing.assert_close(
        task.reward(state, action, state), task.reward(turned, action, turned)
    )
    assert torch.equal(task.is_terminated(state), task.is_terminated(turned))


@all_tasks
def test_step_is_semi_implicit_euler_on_the_true_world(name):
    task = get_task(name)
    state = task.coverage.sample([32], dtype=torch.float64)
    action = torch.tensor([task.action_high], dtype=torch.float64).expand(32, -1)
    new = task.step(state, action)
    rate = task.system.derivative(state, action)
    positions = [task.system.state_names.index(q) for q in task.system.velocity_of]
    speeds = list(task.system.velocity_indices)
    limit = torch.tensor(TABLE[name][6], dtype=torch.float64)
    expected = (state[:, speeds] + task.time_step * rate[:, speeds]).clamp(-limit, limit)
    torch.testing.assert_close(new[:, speeds], expected)
    torch.testing.assert_close(new[:, positions], state[:, positions] + task.time_step * expected)


def test_a_pendulum_step_by_hand():
    # At 90 degrees with 1 N·m: 15 sin + 3 a - 0.5 omega = 15 + 3 - 1 = 17 rad/s².
    new = get_task("pendulum").step(torch.tensor([PI / 2, 2.0]), torch.tensor([1.0]))
    assert new.tolist() == pytest.approx([PI / 2 + 0.05 * 2.85, 2.85])


@all_tasks
def test_actions_are_clipped_to_their_bounds(name):
    task = get_task(name)
    state = task.coverage.sample([16])
    high = torch.tensor(task.action_high).expand(16, -1)
    assert torch.equal(task.step(state, 100 * high), task.step(state, high))
    assert torch.equal(task.step(state, -100 * high), task.step(state, -high))
    assert not torch.equal(task.step(state, high), task.step(state, 0.5 * high))


@all_tasks
def test_the_integrator_is_a_choice(name):
    task = get_task(name)
    state, action = (
        task.reset.sample([4], dtype=torch.float64),
        torch.zeros(4, task.system.action_dim),
    )
    action = action.double()
    euler, rk4, dopri5 = (
        task.step(state, action, i) for i in ("semi_implicit_euler", "rk4", "dopri5")
    )
    torch.testing.assert_close(rk4, dopri5, rtol=1e-3, atol=1e-3)
    assert not torch.equal(euler, rk4)
    assert torch.equal(replace(task, integrator="rk4").step(state, action), rk4)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@all_tasks
def test_any_leading_batch_dimensions_and_dtype(name, batch):
    task = get_task(name)
    for dtype in (torch.float32, torch.float64):
        state = task.reset.sample(list(batch), dtype=dtype)
        action = torch.zeros(*batch, task.system.action_dim, dtype=dtype)
        new = task.step(state, action)
        assert (new.shape, new.dtype) == (state.shape, dtype)
        for reward in (task.reward, task.exploration_reward or task.reward):
            value = reward(state, action, new)
            assert (value.shape, value.dtype) == (batch, dtype)
        assert task.is_terminated(new).shape == batch


# The registry.


@pytest.fixture
def registry(monkeypatch):
    """A copy of the registry, so that a test leaves nothing behind."""
    tasks = {name: get_task(name) for name in list_tasks()}
    monkeypatch.setattr("phihp_torchrl.tasks.registry._TASKS", tasks)


@pytest.mark.usefixtures("registry")
def test_a_task_of_the_users_own():
    system = Pendulum({"gravity": 1.6})
    task = register_task(replace(get_task("pendulum"), name="moon", system=system, env_id=None))
    assert get_task("moon") is task
    assert "moon" in list_tasks()
    with pytest.raises(ValueError, match=r"^task: 'moon' is registered already"):
        register_task(task)
    heavier = replace(task, system=Pendulum({"mass": 2.0}))
    assert register_task(heavier, replace=True) is get_task("moon")


def test_unknown_tasks_are_named_with_those_there_are():
    with pytest.raises(ValueError, match=r"^task: expected one of \['acrobot'.*got 'unicycle'"):
        get_task("unicycle")


def test_tasks_are_frozen_and_hashable():
    task = get_task("acrobot")
    with pytest.raises(AttributeError):
        task.max_steps = 1
    assert {task: 1}[get_task("acrobot")] == 1


# Bad input names the field.


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("action_high", ()),
        ("action_high", (1.0, 1.0)),
        ("action_high", (0.0,)),
        ("action_high", (-1.0,)),
        ("action_high", (math.nan,)),
        ("action_high", (math.inf,)),
        ("time_step", 0.0),
        ("time_step", -0.1),
        ("time_step", math.nan),
        ("max_steps", 0),
        ("max_steps", -5),
        ("max_steps", 2.5),
        ("reset", Box((0.0,), (1.0,))),
        ("coverage", Box((0.0,) * 3, (1.0,) * 3)),
        ("goal", Box((), ())),
        ("integrator", "euler"),
        ("velocity_limits", {"speed": 1.0}),
    ],
)
def test_task_validation_names_the_field(field, value):
    with pytest.raises(ValueError, match=rf"^{field}: "):
        replace(get_task("pendulum"), **{field: value})


def test_velocity_limits_must_be_positive():
    with pytest.raises(ValueError, match=r"limits: expected positive"):
        replace(get_task("pendulum"), velocity_limits={"theta_dot": 0.0})


def test_a_task_is_one_call():
    task = Task(
        name="balance",
        system=Pendulum(),
        action_high=(1.0,),
        time_step=0.1,
        max_steps=10,
        reset=Box((0.0, 0.0), (0.0, 0.0)),
        reward=lambda state, action, next_state: next_state[..., 0].cos(),
        velocity_limits={"theta_dot": 3.0},
    )
    assert task.layout.limits == (3.0,)
    assert not task.is_terminated(task.reset.sample([2])).any()


@pytest.mark.parametrize(
    ("low", "high"),
    [((0.0,), ()), ((1.0,), (0.0,)), ((math.nan,), (1.0,)), ((-math.inf,), (0.0,))],
)
def test_box_validation_names_its_corners(low, high):
    with pytest.raises(ValueError, match=r"^low, high: "):
        Box(low, high)


def test_box_around_a_centre():
    assert Box.around((1.0, 2.0), (0.5, 0.0)) == Box((0.5, 2.0), (1.5, 2.0))
    with pytest.raises(ValueError, match=r"^center, radius: "):
        Box.around((1.0, 2.0), (0.5,))
    with pytest.raises(ValueError, match=r"^low, high: "):
        Box.around((1.0,), (-0.5,))


def test_box_samples_are_seeded():
    box = Box((0.0, -1.0), (0.0, 1.0))
    first, second = (
        box.sample([3, 2], generator=torch.Generator().manual_seed(7)) for _ in range(2)
    )
    assert torch.equal(first, second)
    assert first.shape == (3, 2, 2)
    assert (first[..., 0] == 0).all()
    assert box.sample([0]).shape == (0, 2)
    assert box.sample([], dtype=torch.float64).dtype == torch.float64
