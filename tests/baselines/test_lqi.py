"""The regulator that follows: no steady error, steps, bounds, lag, and what it refuses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are
from tensordict import TensorDict
from torch import Tensor

from phihp_torchrl import ConfigError, HybridDynamics, Signal, get_task
from phihp_torchrl.baselines import LQI, LQR, make_baselines
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Actuator, Disturbance, Task

from .parts import Leak, Slider, Stray, Tank, TwoTanks, following, play, prior_of, task_of


def chase(lqi: LQI, task: Task, references: list[float], truth=None, start: float = 0.0) -> Tensor:
    """The first component at each step, ``[steps + 1]``, of a reference that moves by itself."""
    model = TaskWorldModel(task, truth or prior_of(task))
    physical = torch.zeros(1, task.system.state_dim)
    physical[0, 0] = start
    state, seen = task.at_rest(physical), [start]
    for k, wanted in enumerate(references):
        signals = torch.full((1, task.outside.size), wanted)
        state = task.with_signals(state, signals)
        data = TensorDict(
            observation=model.observe(state), is_init=torch.tensor([[k == 0]]), batch_size=[1]
        )
        with torch.no_grad():
            state = model.transition(state, lqi(data)["action"]).next_state
        seen.append(state[0, 0].item())
    return torch.tensor(seen)


def lqi_of(task: Task, dynamics=None, **options) -> LQI:
    return LQI.from_model(task, dynamics or prior_of(task), **options)


STEP = [0.5] * 100 + [2.5] * 100


@pytest.mark.parametrize("preview", [0, 3])
@pytest.mark.parametrize("system", [Tank(), TwoTanks()])
def test_it_follows_a_step_and_does_not_overshoot_where_the_model_is_right(
    system: System, preview: int
) -> None:
    task = following(system, preview=preview)
    levels = chase(lqi_of(task), task, STEP)
    assert levels[100].item() == pytest.approx(0.5, abs=1e-3)
    assert levels[-1].item() == pytest.approx(2.5, abs=1e-3)
    assert levels.max() < 2.5 + 0.02


def test_a_load_that_nobody_is_told_of_leaves_no_steady_error() -> None:
    task, leaking = following(Tank()), task_of(Leak())
    lqi = lqi_of(task)
    levels = chase(lqi, task, STEP, prior_of(leaking))
    assert levels[100].item() == pytest.approx(0.5, abs=1e-4)
    assert levels[-1].item() == pytest.approx(2.5, abs=1e-4)
    lqi.integral_gain.zero_()
    assert (chase(lqi, task, STEP, prior_of(leaking))[-1] - 2.5).abs() > 0.05


def test_gains_are_those_of_the_riccati_equation_of_state_and_integral() -> None:
    task = following(Tank())
    lqi = lqi_of(task, state_weights=[2.0], action_weights=[0.5], integral_time=0.4)
    a = np.array([[1.0 - 0.1 * 0.5, 0.0], [0.1, 1.0]])  # one step of Euler, and the sum of errors
    b = np.array([[0.1 * 2.0], [0.0]])
    cost = solve_discrete_are(a, b, np.diag([2.0, 2.0 / 0.4**2]), np.array([[0.5]]))
    gain = np.linalg.solve(0.5 + b.T @ cost @ b, b.T @ cost @ a)
    np.testing.assert_allclose(torch.cat([lqi.gain, lqi.integral_gain], 1), gain, rtol=1e-9)


def test_without_an_integral_time_it_is_that_of_the_loop() -> None:
    task = following(Tank())
    lqi = lqi_of(task)
    # A first-order loop has the area of its time constant below a step.
    inner = LQR.from_model(task_of(Tank()), prior_of(task), state_weights=[1.01],
                           action_weights=[0.1 / 25.0])  # fmt: skip
    closed = 0.95 - 0.2 * inner.gain.item()
    assert lqi.times == pytest.approx([0.1 / (1.0 - closed)], rel=1e-6)


def test_a_reward_of_the_size_of_the_error_weighs_it_too() -> None:
    squared = following(Tank())
    for power in (1.0, 3.0):  # with a kink, and flat

        def reward(state, action, next_state, reference, power=power):
            return -(next_state[..., 0] - reference[..., 0]).abs() ** power  # fmt: skip

        other = lqi_of(replace(squared, reward=reward))
        torch.testing.assert_close(other.gain, lqi_of(squared).gain, rtol=0.05, atol=0.0)


def test_its_integral_stands_still_while_the_action_is_on_its_bound() -> None:
    task = following(Tank())
    lqi = lqi_of(task)
    levels = chase(lqi, task, [3.0] * 150 + [0.5] * 100, start=-30.0)  # takes it 30 steps
    assert levels.max() < 3.02
    assert levels[-1].item() == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("limit", [5.0, 0.5])
def test_nor_does_it_wind_up_on_the_bound_of_a_rate(limit: float) -> None:
    task = replace(following(Tank()), action_rate_limit=limit)
    levels = chase(lqi_of(task), task, [0.0] * 10 + [1.0] * 290)
    assert levels.max() < 1.25
    assert levels[-1].item() == pytest.approx(1.0, abs=1e-2)


@pytest.mark.parametrize("extra", [{}, {"disturbance": Disturbance(high={"level": 2.0})}])
def test_it_reckons_with_lag_and_dead_time(extra: dict) -> None:
    late = Actuator(delay_steps=2.0, lag=0.3)
    task = replace(following(Tank(), preview=1), actuator=late, **extra)
    truth = prior_of(task_of(Leak()))
    lqi = lqi_of(task)
    assert lqi.gain.shape == (1, 4)
    levels = chase(lqi, task, STEP, truth)
    assert levels[100].item() == pytest.approx(0.5, abs=1e-3)
    assert levels[-1].item() == pytest.approx(2.5, abs=1e-3)
    assert chase(lqi, task, STEP).max() < 2.6
    prompt = replace(task, actuator=None)
    blind = lqi_of(prompt)
    blind.task, blind.point = task, replace(blind.point, task=task)
    blind.equilibria = replace(blind.equilibria, point=blind.point)
    assert (chase(blind, task, STEP, truth)[-30:] - 2.5).abs().max() > 0.1, "it keeps swinging"


class Mixed(System):
    """Heat and water, each of which changes both how warm and how wet it is."""

    state_names, action_names = ("warm", "wet"), ("heat", "water")
    load = 0.0

    def prior(self, state, action, constants):
        heat, water = action.unbind(-1)
        rates = torch.stack([heat - 0.5 * water, 0.3 * heat + water], -1)
        return rates - 0.4 * state + self.load


class Loaded(Mixed):
    load = 0.7


def test_two_components_by_two_actions() -> None:
    def reward(state, action, next_state, reference):
        return -(next_state - reference.flip(-1)).square().sum(-1)

    both = Signal(("wet", "warm"), (-1.0, -2.0), (1.0, 2.0))
    task = replace(task_of(Mixed()), reference=both, reward=reward)
    lqi = lqi_of(task)
    wanted = torch.tensor([0.8, -1.5])
    start = task.with_signals(task.at_rest(torch.zeros(2)), wanted)
    states = play(lqi, task, start, 150, prior_of(task_of(Loaded())))
    torch.testing.assert_close(states[-1, :2], wanted.flip(0), atol=1e-3, rtol=0.0)


def test_a_cart_follows_with_its_pole_up() -> None:
    def reward(state, action, next_state, reference):
        error = next_state[..., 0] - reference[..., 0]
        return -error.square() - next_state[..., 2].square()

    place = Signal(("x",), (-1.0,), (1.0,))
    task = replace(get_task("cartpole"), reference=place, reward=reward)
    model = HybridDynamics.pure_prior(task)
    places = chase(lqi_of(task, model), task, [0.6] * 250 + [-0.4] * 250, model)
    assert places[250].item() == pytest.approx(0.6, abs=0.02)
    assert places[-1].item() == pytest.approx(-0.4, abs=0.02)


# Equilibria.


def pendulum(low: float, high: float) -> Task:
    def reward(state, action, next_state, reference):
        return -(next_state[..., 0] - reference[..., 0]).square()

    angle = Signal(("theta",), (low,), (high,))
    return replace(get_task("pendulum"), reference=angle, reward=reward, **torque(20.0))


def torque(most: float) -> dict:
    return {"action_low": (-most,), "action_high": (most,)}


def test_gravity_is_reckoned_with_where_the_reference_is() -> None:
    task = pendulum(-1.0, 1.0)
    dynamics = HybridDynamics.pure_prior(task)
    equilibria = lqi_of(task, dynamics).equilibria
    wanted = torch.linspace(-1.0, 1.0, 7).unsqueeze(-1)
    state, action = equilibria.at(wanted)
    torch.testing.assert_close(state[:, :1], wanted)
    rates = task.system.prior(state[:, :2], action, task.system.constants)
    assert rates.abs().max() < 0.05  # of up to 12 rad/s²; between two values of the table
    assert (action.diff(dim=0) / wanted.diff(dim=0)).std() > 0.1, "it is no straight line"


def test_a_reference_beyond_the_last_rest_counts_as_that_one() -> None:
    task = pendulum(-1.0, 1.0)
    weak, constants = replace(task, **torque(2.0)), task.system.constants
    equilibria = lqi_of(weak, HybridDynamics.pure_prior(weak)).equilibria
    state, _ = equilibria.at(torch.tensor([[0.1], [0.6], [1.0]]))
    assert state[0, 0].item() == pytest.approx(0.1)
    torch.testing.assert_close(state[1], state[2])
    # Gravity that 2 Nm can hold: of an angle whose sine is 2 over that at a right angle.
    right = task.system.prior(torch.tensor([torch.pi / 2, 0.0]), torch.zeros(1), constants)[1]
    push = task.system.prior(torch.zeros(2), torch.full((1,), 2.0), constants)[1]
    assert state[2, 0].item() == pytest.approx(math.asin(push / right), abs=0.01)


def test_rows_are_apart_and_an_episode_starts_anew() -> None:
    task = following(Tank())
    lqi = lqi_of(task)
    state = torch.tensor([[0.4, 0.5], [0.6, 0.5]])
    observation = task.observe(state)
    first = lqi(TensorDict(observation=observation, batch_size=[2]))["action"]
    later = lqi(TensorDict(observation=observation, batch_size=[2]))["action"]
    assert later[0] > first[0]
    assert later[1] < first[1]
    starts = torch.tensor([[True], [False]])
    last = lqi(TensorDict(observation=observation, is_init=starts, batch_size=[2]))["action"]
    assert last[0] == first[0]
    assert last[1] < later[1]
    lqi.reset()
    again = lqi(TensorDict(observation=observation, batch_size=[2]))["action"]
    torch.testing.assert_close(again, first)


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_it_takes_any_batch_in_any_precision(shape: tuple[int, ...]) -> None:
    task = following(TwoTanks(), preview=2)
    lqi = lqi_of(task)
    for dtype in (torch.float32, torch.float64):
        data = TensorDict(observation=torch.ones(*shape, 5, dtype=dtype), batch_size=shape)
        for _ in range(2):
            action = lqi(data)["action"]
            assert (action.shape, action.dtype) == ((*shape, 1), dtype)
    unknown = torch.full((*shape, 5), torch.nan)
    assert lqi(TensorDict(observation=unknown, batch_size=shape))["action"].isnan().all()


# What it refuses.


class Stuck(Tank):
    """A tank with such a leak that hardly any level can be kept."""

    def prior(self, state, action, constants):
        return 1e-4 * action - 9.0 * state


def far(name: str, low: float, high: float, system: System) -> Task:
    return replace(following(system, name), reference=Signal((name,), (low,), (high,)))


REFUSED = {
    "no rest": (
        far("level", 60.0, 90.0, Tank()),
        "goal: expected a state to stay in: the model drifts from",
    ),
    "a velocity": (following(Slider(), "x_dot"), "reference: .* 'x_dot' is the velocity of 'x'"),
    "no state": (
        following(Tank(), "price"),
        r"reference: expected one of components of \('level',\)",
    ),
    "no effect": (far("drift", -1.0, 1.0, Stray()), "does not reach the mode of drift"),
    "two by one": (
        replace(following(TwoTanks()), reference=Signal(("level", "upper"), (-1, -1), (1, 1))),
        "inflow does not reach the mode of the integral of",
    ),
    "one rest": (far("level", -90.0, 90.0, Stuck()), "of 'level' it rests at 0 alone"),
    "none": (task_of(Tank()), r"reference: expected one of components of \('level',\)"),
}


@pytest.mark.parametrize("why", REFUSED)
def test_what_it_cannot_follow_is_refused_by_name(why: str) -> None:
    task, words = REFUSED[why]
    with pytest.raises(ConfigError, match=words):
        lqi_of(task)
    if task.reference is not None:
        with pytest.raises(ConfigError, match=f"'lqr' does not apply: .*{words.split(':')[-1]}"):
            make_baselines(task, prior_of(task), ["lqr"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"state_weights": [0.0]}, r"state_weights: expected them above 0 for \['level'\]"),
        ({"action_weights": [1.0, 1.0]}, "action_weights: expected 1 numbers above 0"),
        ({"integral_time": 0.0}, "integral_time: expected a number above 0, got 0.0"),
    ],
)
def test_wrong_arguments_are_named(options: dict, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        lqi_of(following(Tank()), **options)
