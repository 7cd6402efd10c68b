"""Iterative LQR: what it plans, its bounds, its memory, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import ConfigError, HybridDynamics, get_task
from phihp_torchrl.baselines import ILQR, LQR, ILQRConfig, make_baselines
from phihp_torchrl.tasks import Actuator, Constraint, Signal, Task

from .parts import Slider, play, prior_of, task_of

SMALL = ILQRConfig(horizon=10, rounds=1, first_rounds=4, guesses=4)


def push(action_high: float = 5.0, **options) -> Task:
    return replace(task_of(Slider(), **options), action_high=(action_high,))


def acting(controller: ILQR, state: torch.Tensor, starts: torch.Tensor | None = None):
    observation = controller.task.observe(state)
    data = TensorDict(observation=observation, batch_size=state.shape[:-1])
    if starts is not None:
        data["is_init"] = starts.unsqueeze(-1)
    return controller(data)["action"]


def earned(task: Task, states: torch.Tensor) -> torch.Tensor:
    """Returns of a pendulum whose states ``[steps + 1, *batch, 2]`` were met; torque left out."""
    return task.reward(states[:-1], torch.zeros_like(states[:-1, ..., :1]), states[1:]).sum(0)


def test_where_all_is_quadratic_it_is_the_regulator() -> None:
    task = push()
    dynamics = prior_of(task)
    lqr = LQR.from_model(task, dynamics)
    ilqr = ILQR.from_model(task, dynamics, ILQRConfig(horizon=40, first_rounds=3))
    weights = torch.as_tensor(lqr.cost)
    state = torch.tensor([[0.1, 0.0], [-0.05, 0.1]])
    expansion = ilqr.problem.expand(
        ilqr.problem.roll(state, lambda k, s: torch.zeros_like(s[..., :1]), 3)
    )
    a, b = (torch.as_tensor(m).float() for m in (lqr.point.a, lqr.point.b))
    torch.testing.assert_close(expansion.slope[0, 0], torch.cat([a, b * 5.0], -1))
    unit = lqr.unit / ilqr.problem.spread
    torch.testing.assert_close(expansion.last_curvature[0], unit * weights.float())
    # The regulator prices actions by 10 % more than the reward does: near, not the same.
    torch.testing.assert_close(acting(ilqr, state), lqr.act(state), rtol=0.25, atol=0.02)


def test_it_swings_a_pendulum_up_within_its_torque_where_the_regulator_fails() -> None:
    task = get_task("pendulum")
    dynamics = HybridDynamics.pure_prior(task)
    start = torch.tensor([[2.8, 0.2], [-2.0, -1.0]])
    config = ILQRConfig(horizon=30, rounds=1, first_rounds=6, guesses=16)
    ours = play(ILQR.from_model(task, dynamics, config), task, start, 60, dynamics)
    theirs = play(LQR.from_model(task, dynamics), task, start, 60, dynamics)
    assert (ours[-5:, :, 0].cos() > 0.95).all()
    assert (theirs[-5:, :, 0].cos() < 0.5).any(0).all()
    assert (earned(task, ours) > 0.7 * earned(task, theirs)).all()


def test_a_round_never_makes_a_plan_dearer_and_keeps_its_bounds() -> None:
    task = get_task("cartpole-swingup")
    ilqr = ILQR.from_model(task, HybridDynamics.pure_prior(task), SMALL)
    state = task.coverage.sample([16], generator=torch.Generator().manual_seed(2))
    plan = ilqr._follow(state, torch.zeros(10, 16, 1))
    damping, active = torch.full([16], 1e-3), torch.arange(16) < 12
    first = plan
    for _ in range(4):
        later, damping = ilqr._improve(plan, damping, active)
        assert (later.cost <= plan.cost).all()
        assert later.actions.abs().max() <= 1.0
        plan = later
    assert (plan.cost < first.cost)[:12].sum() > 8
    torch.testing.assert_close(plan.actions[:, 12:], first.actions[:, 12:], rtol=0, atol=0)
    again = ilqr._follow(state, plan.actions)
    torch.testing.assert_close(again.cost, plan.cost, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("shape", [(), (3,), (2, 2)])
def test_it_takes_any_batch_and_rows_do_not_meet(shape: tuple[int, ...]) -> None:
    task = get_task("cartpole")  # whose reward is flat: the weights of the regulator count
    ilqr = ILQR.from_model(task, HybridDynamics.pure_prior(task), SMALL)
    state = task.reset.sample(list(shape), generator=torch.Generator().manual_seed(0))
    action = acting(ilqr, state)
    assert action.shape == (*shape, 1)
    ilqr.reset()
    alone = acting(ilqr, state.reshape(-1, 4)[-1])
    torch.testing.assert_close(action.reshape(-1, 1)[-1], alone, rtol=1e-3, atol=1e-3)


def test_a_new_episode_starts_from_new_guesses_in_its_row_alone() -> None:
    task = get_task("pendulum")
    ilqr = ILQR.from_model(task, HybridDynamics.pure_prior(task), SMALL)
    state = torch.tensor([[3.0, 0.1], [3.0, 0.1]])
    fresh = acting(ilqr, state)
    assert ilqr._damping is not None
    first = ilqr._damping
    again = acting(ilqr, state, torch.tensor([True, False]))
    torch.testing.assert_close(again[0], fresh[0], rtol=0, atol=0)
    assert ilqr._damping[0] == first[0]  # the same start, the same rounds
    assert ilqr._damping[1] != first[1]  # another round, from the plan before
    ilqr.reset()
    torch.testing.assert_close(acting(ilqr, state), fresh, rtol=0, atol=0)


def test_it_reckons_with_what_is_under_way_and_with_a_reference() -> None:
    late = push(actuator=Actuator(delay_steps=2.0, lag=0.05))
    config = ILQRConfig(horizon=15, rounds=1, first_rounds=4, guesses=4)
    ilqr = ILQR.from_model(late, prior_of(late), config)
    states = play(ilqr, late, late.at_rest(torch.tensor([0.3, 0.0])), 25)
    assert states[-1, 0] < 0.12
    assert states[:, 0].min() > -0.03  # and does not overshoot

    def follow(state, action, next_state, reference):
        return -(next_state[..., 0] - reference[..., 0]).square() - 1e-3 * action[..., 0] ** 2

    to = replace(push(), reference=Signal(("x",), (-1.0,), (1.0,)), reward=follow)
    ilqr = ILQR.from_model(to, prior_of(to), config)
    assert ilqr.problem.lqr is None
    state = to.with_signals(to.at_rest(torch.zeros(2, 2)), torch.tensor([[0.5], [-0.5]]))
    action = acting(ilqr, state)
    assert action[0] > 0 > action[1]


def test_constraints_cost_their_price_and_turn_it_away() -> None:
    power = Constraint("power", high=0.5, price=2.0, function=lambda s, action: action[..., 0])
    slow = Constraint("x_dot", low=-0.1, price=20.0)
    free, held = push(), push(constraints=(slow, power))
    config = ILQRConfig(horizon=15, rounds=1, first_rounds=6, guesses=4)
    plans = [ILQR.from_model(task, prior_of(task), config) for task in (free, held)]
    state, unit, after = (torch.tensor([row]) for row in ([0.5, 0.0], [0.4], [0.5, -0.5]))
    spread = plans[0].problem.spread
    paid = plans[1].problem.pay(state, unit, after) - plans[0].problem.pay(state, unit, after)
    torch.testing.assert_close(paid, torch.tensor([(20.0 * 0.4 + 2.0 * 1.5) / spread]))
    fastest = [play(plan, plan.task, state, 20)[..., 1].min() for plan in plans]
    assert fastest[1] > -0.13 > fastest[0]


def test_what_it_cannot_do_is_named() -> None:
    task = get_task("acrobot")
    dynamics = HybridDynamics.pure_prior(task)
    with pytest.raises(ConfigError, match=r"'ilqr' does not apply: reward: .* of 'acrobot' has no"):
        make_baselines(task, dynamics, ["ilqr"])
    assert "ilqr" not in make_baselines(task, dynamics)
    with pytest.raises(ConfigError, match="horizon: expected"):
        ILQRConfig(horizon=0)
    with pytest.raises(ConfigError, match=r"step_sizes: expected some numbers in \(0, 1\], got"):
        ILQRConfig(step_sizes=(2.0,))
