"""Constraints by hand: what a violation is, costs and ends, and what is refused by its name."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phihp_torchrl import Constraint, HybridDynamics, get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.tasks import Box

SWINGUP = get_task("cartpole-swingup")
NEAR = Constraint("x", low=-1.0, high=1.5, price=4.0)
POWER = Constraint(
    "power", high=3.0, price=2.0, function=lambda state, action: state[..., 1] * action[..., 0]
)
WALL = Constraint("x", high=1.0, hard=True)


def limited(*constraints, **changes):
    return replace(SWINGUP, constraints=constraints, **changes)


def stay(state, action):
    return state


def at(*rows):
    """States with the given positions and velocities of the cart, ``[rows, 4]``."""
    return torch.tensor([[x, v, 0.0, 0.0] for x, v in rows])


def test_a_soft_constraint_costs_by_its_violation_after_the_step():
    task, action = limited(NEAR), torch.zeros(4, 1)
    state = at((0.0, 0.0), (1.75, 0.0), (-1.25, 0.0), (1.5, 0.0))
    found, plain = (t.transition(stay, state, action) for t in (task, SWINGUP))
    torch.testing.assert_close(plain.reward - found.reward, torch.tensor([0.0, 1.0, 1.0, 0.0]))
    assert not found.terminated.any()
    assert found.next_state.equal(state)
    moved = task.transition(lambda s, a: s + 1.0, at((1.0, 0.0)), torch.zeros(1, 1))
    earned = task.earned(at((1.0, 0.0)), torch.zeros(1, 1), at((1.0, 0.0)) + 1.0)
    torch.testing.assert_close(moved.reward, earned - 4.0 * 0.5)


def test_a_function_is_of_the_state_and_the_command_that_is_given():
    task = limited(NEAR, POWER)
    state, action = at((1.75, 2.0), (0.0, 1.0)), torch.tensor([[2.0], [99.0]])  # 99 N are 10 N
    violations = task.limits.violations(state, task.clip_action(action))
    torch.testing.assert_close(violations, torch.tensor([[0.25, 1.0], [0.0, 7.0]]))
    paid = torch.tensor([1.0 + 2.0, 14.0])
    torch.testing.assert_close(task.price(state, action, state), paid)
    plain = SWINGUP.transition(stay, state, action).reward
    torch.testing.assert_close(task.transition(stay, state, action).reward, plain - paid)


def test_a_function_of_the_state_alone_is_given_no_action():
    tip = Constraint("tip", low=0.0, price=1.0, function=lambda s: s[..., 2].cos())
    state = torch.tensor([[0.0, 0.0, torch.pi, 0.0]])
    assert limited(tip).limits.violations(state).tolist() == [[1.0]]


def test_prices_add_to_that_of_the_rate():
    task = limited(NEAR, action_rate_cost=0.5)
    state = torch.cat([at((1.75, 0.0)), torch.zeros(1, 1)], -1)
    price = task.price(state, torch.full((1, 1), 10.0), state)
    assert price.tolist() == [0.5 + 1.0]
    free = task.unpriced()
    assert free.action_rate_cost == 0.0
    assert free.constraints[0].price == 0.0
    assert free.limits.violations(at((1.75, 0.0))).tolist() == [[0.25]]


def test_a_hard_constraint_ends_beside_the_end_of_the_task_itself():
    state = at((0.0, 0.0), (1.01, 0.0), (1.0, 0.0))
    found = limited(WALL).transition(stay, state, torch.zeros(3, 1))
    assert found.terminated.tolist() == [False, True, False]
    assert limited(WALL).price(state, torch.zeros(3, 1), state) is None
    task = replace(get_task("cartpole"), constraints=(WALL,))
    leaning = torch.tensor([[0.0, 0.0, 1.0, 0.0], [1.5, 0.0, 0.0, 0.0], [0.0] * 4])
    assert task.is_terminated(leaning).tolist() == [True, True, False]


def test_the_price_of_an_end_is_paid_once_and_in_imagination_alone():
    task = limited(replace(WALL, price=7.0))
    state = at((0.0, 0.0), (1.5, 0.0), (3.0, 0.0))
    assert task.price(state, torch.zeros(3, 1), state).tolist() == [0.0, 7.0, 7.0]
    assert task.unpriced().price(state, torch.zeros(3, 1), state) is None
    assert task.unpriced().is_terminated(state).tolist() == [False, True, True]


def test_a_hard_function_of_the_action_ends_by_the_command():
    task = limited(replace(POWER, price=None, hard=True))
    state, action = at((0.0, 1.0), (0.0, 1.0)), torch.tensor([[2.0], [4.0]])
    assert task.transition(stay, state, action).terminated.tolist() == [False, True]
    with pytest.raises(ConfigError, match=r"constraints\.power: expected the command"):
        task.is_terminated(state)


def test_angles_are_judged_on_the_circle():
    task = limited(Constraint("theta", low=-1.0, high=1.0, price=1.0))
    turned = torch.tensor(
        [[0.0, 0.0, 0.5 + 2 * torch.pi, 0.0], [0.0, 0.0, 1.25 - 4 * torch.pi, 0.0]]
    )
    torch.testing.assert_close(
        task.limits.violations(turned), torch.tensor([[0.0], [0.25]]), rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("shape", [[], [3], [2, 3]])
def test_a_batch_is_its_rows(shape):
    task = limited(NEAR, POWER, replace(WALL, name="end", function=lambda s: s[..., 0]))
    generator = torch.Generator().manual_seed(0)
    state = 2.0 * torch.randn(*shape, 4, generator=generator, dtype=torch.float64)
    action = 5.0 * torch.randn(*shape, 1, generator=generator, dtype=torch.float64)
    assert task.limits.violations(state, action).shape == (*shape, 3)
    whole = task.transition(stay, state, action)
    assert whole.reward.shape == whole.terminated.shape == tuple(shape)
    assert whole.reward.dtype == torch.float64
    rows = task.transition(stay, state.reshape(-1, 4)[-1], action.reshape(-1, 1)[-1])
    for one, other in zip(rows, whole, strict=True):
        torch.testing.assert_close(one, other.reshape(-1, *one.shape)[-1])


def test_a_task_without_constraints_is_as_before():
    state, action = torch.randn(5, 4), torch.randn(5, 1)
    assert SWINGUP.price(state, action) is None
    assert SWINGUP.unpriced() is SWINGUP
    assert SWINGUP.limits.violations(state).shape == (5, 0)
    reported = limited(replace(NEAR, price=0.0))
    assert reported.unpriced() is reported
    for one, other in zip(
        SWINGUP.transition(stay, state, action),
        reported.transition(stay, state, action),
        strict=True,
    ):
        assert one.equal(other)


def test_a_constrained_step_compiles_as_one_graph():
    task = limited(NEAR, POWER, replace(WALL, name="end", function=lambda s: s[..., 0]))
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    compiled = torch.compile(model.transition, fullgraph=True, backend="eager")
    state, action = at((2.0, 5.0), (0.0, 0.0)), torch.full((2, 1), 9.0)
    with torch.no_grad():
        expected = model.transition(state, action)
        for one, other in zip(compiled(state, action), expected, strict=True):
            torch.testing.assert_close(one, other)
    assert expected.terminated.tolist() == [True, False]


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: Constraint("", high=1.0, price=1.0), "constraints.name"),
        (lambda: Constraint("x", price=1.0), "constraints.x.low"),
        (lambda: Constraint("x", 1.0, 1.0, price=1.0), "constraints.x.low"),
        (lambda: Constraint("x", high=float("nan"), price=1.0), "constraints.x.high"),
        (lambda: Constraint("x", high="1", price=1.0), "constraints.x.high"),
        (lambda: Constraint("x", high=1.0), "constraints.x.price"),
        (lambda: Constraint("x", high=1.0, price=-1.0), "constraints.x.price"),
        (lambda: Constraint("x", high=1.0, hard=1), "constraints.x.hard"),
        (lambda: Constraint("x", high=1.0, price=1.0, function=3), "constraints.x.function"),
        (lambda: limited("x"), "constraints[0]"),
        (lambda: replace(SWINGUP, constraints=NEAR), "constraints"),
        (lambda: limited(Constraint("y", high=1.0, price=1.0)), "constraints.y"),
        (lambda: limited(NEAR, WALL), "constraints.x"),
        (lambda: limited(Constraint("theta", high=4.0, price=1.0)), "constraints.theta"),
        (lambda: limited(replace(POWER, function=lambda s: s)), "constraints.power.function"),
        (
            lambda: limited(WALL, reset=Box.around((1.0, 0.0, 0.0, 0.0), (0.1,) * 4)),
            "constraints.x",
        ),
        (
            lambda: limited(Constraint("theta", low=-1.0, high=1.0, hard=True)),
            "constraints.theta",
        ),
        (
            lambda: limited(
                Constraint("up", low=0.0, hard=True, function=lambda s: s[..., 2].cos())
            ),
            "constraints.up",
        ),
        (
            lambda: limited(NEAR).price(torch.zeros(2, 4), torch.zeros(2, 1)),
            "next_state",
        ),
    ],
)
def test_what_is_wrong_is_refused_by_name(make, key):
    with pytest.raises(ConfigError) as error:
        make()
    assert error.value.key == key


def test_settings_of_an_unknown_constraint_tell_the_known_ones():
    known = (
        r"expected one of the task's constraints \['x', 'power'\] or of the states "
        r"\['x', 'x_dot', 'theta', 'theta_dot'\]"
    )
    task = limited(NEAR, POWER)
    for name, changes, hint in (
        ("powr", {"price": 5.0}, r"; did you mean 'power'\?"),
        ("thta", {"high": 1.0, "price": 5.0}, r"; did you mean 'theta'\?"),
        ("zzz", {"price": 5.0}, r"\."),
        ("powr", None, r"; did you mean 'power'\?"),
    ):
        with pytest.raises(
            ConfigError, match=rf"^constraints\.{name}: unknown name, {known}{hint}$"
        ):
            task.with_constraints({name: changes})
    assert task.with_constraints({"power": {"price": 5.0}}).constraints[1].price == 5.0
    assert task.with_constraints({"x_dot": {"high": 1.0, "price": 5.0}}).limits.names[2] == "x_dot"
    with pytest.raises(ConfigError, match=r"or a function; did you mean 'theta'\?$"):
        limited(Constraint("thta", high=1.0, price=1.0))


@pytest.mark.parametrize(
    "function",
    [
        lambda state, command: command[..., 0],
        lambda state, action, next_state: next_state[..., 0],
        lambda: 0.0,
        lambda state: 0.0,
        lambda state: state[..., 99],
    ],
)
def test_a_function_that_cannot_be_called_is_refused_with_what_it_is_called_with(function):
    with pytest.raises(
        ConfigError, match=r"function\(state\) or function\(state, action\)"
    ) as error:
        limited(replace(POWER, function=function))
    assert error.value.key == "constraints.power.function"


def test_some_starts_within_a_hard_constraint_are_enough():
    right = Constraint("right", low=0.0, hard=True, function=lambda state: state[..., 0])
    half = Constraint("theta", low=0.0, hard=True)
    spread = Box.around((0.0,) * 4, (0.1,) * 4)
    assert limited(right, half, reset=spread).limits.ends_episodes
    # What an action does is not known before there is one.
    assert limited(replace(POWER, price=None, hard=True, low=1.0)).limits.ends_episodes
