"""Limits and stops by the names of a system, and what a stop does to the rest of it."""

from __future__ import annotations

import copy
import math
import re
from dataclasses import replace

import pytest
import torch
from gymnasium.envs.classic_control import Continuous_MountainCarEnv as MountainCar
from physics import ENERGY, all_systems, random_transition

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import HybridDynamics
from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.systems import CartPole, Pendulum, System
from phihp_torchrl.worlds import SimulatedWorld, TaskEnv

inf = math.inf


def test_stops_by_name():
    layout = CartPole().layout(position_limits={"x": (-0.4, 0.5)}, restitution=0.2)
    assert layout.stops == ((-0.4, 0.5), (-inf, inf))
    assert layout.restitution == (0.2, 0.0)
    both = {"theta": (-1.0, 1.0), "x": (-inf, 2.0)}
    layout = CartPole().layout(position_limits=both, restitution={"theta": 0.3})
    assert layout.stops == ((-inf, 2.0), (-1.0, 1.0))
    assert layout.restitution == (0.0, 0.3)
    assert not CartPole().layout({"x_dot": 1.0}).stopped


@pytest.mark.parametrize(
    ("limits", "restitution", "message"),
    [
        ({"y": (0.0, 1.0)}, 0.0, "position_limits: unknown ['y'], expected some of ['x', 'theta']"),
        ({"x": 1.0}, 0.0, "position_limits.x: expected (low, high)"),
        ({"x": (1.0, 0.0)}, 0.0, "position_limits.x: expected (low, high) with low < high"),
        ({"theta": (-1.0, 4.0)}, 0.0, "position_limits.theta: expected both within [-pi, pi]"),
        ({"theta": (-inf, 1.0)}, 0.0, "position_limits.theta: expected both within [-pi, pi]"),
        ({"x": (0.0, 1.0)}, 1.5, "restitution: expected a number in [0, 1], got 1.5"),
        ({"x": (0.0, 1.0)}, {"x": math.nan}, "restitution.x: expected a number in [0, 1]"),
        ({"x": (0.0, 1.0)}, {"theta": 0.5}, "restitution: unknown ['theta'], expected some of"),
    ],
)
def test_what_does_not_fit_is_named(limits, restitution, message):
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        CartPole().layout(position_limits=limits, restitution=restitution)
    # A task looks at the types of its fields first.
    field = re.split(r"[.:]", message)[0]
    with pytest.raises(ConfigError, match=rf"^{field}[.:]"):
        replace(get_task("cartpole"), position_limits=limits, restitution=restitution)


@all_systems
def test_an_elastic_stop_keeps_the_energy_of_the_whole_system(kind):
    system = kind()
    state, _ = random_transition(system)
    for position, velocity in system.velocity_of.items():
        v = system.state_names.index(velocity)
        blow = system.impulse(position, state, system.constants)
        after = state - 2.0 * state[:, v : v + 1] * blow
        torch.testing.assert_close(after[:, v], -state[:, v])
        before, now = (ENERGY[kind](s, system.constants) for s in (state, after))
        torch.testing.assert_close(now, before)


def test_by_default_a_stop_changes_its_own_velocity():
    class Slider(System):
        state_names, action_names = ("x", "x_dot", "charge"), ("u",)
        velocity_of = {"x": "x_dot"}

    assert Slider().impulse("x", torch.randn(2, 3), {}).tolist() == [[0.0, 1.0, 0.0]] * 2


RAIL = replace(get_task("cartpole-swingup"), position_limits={"x": (-0.4, 0.4)}, restitution=0.3)
CRASH = torch.tensor([[0.399, 2.0, 0.4, 0.5], [0.0, 2.0, 0.4, 0.5]], dtype=torch.float64)


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4", "dopri5"])
def test_the_world_and_its_exact_model_stop_a_cart_and_swing_its_pole(integrator):
    free = replace(RAIL, position_limits={}, restitution=0.0)
    action, solver = torch.zeros(2, 1, dtype=torch.float64), make_integrator(integrator)
    moved = {}
    for name, task in (("rail", RAIL), ("free", free)):
        world = SimulatedWorld(task)
        world.integrator = solver
        moved[name] = world.step(CRASH, action)
        env = TaskEnv(task, integrator=solver)
        env.reset(options={"state": CRASH[0].numpy()})
        env.step(action[0].numpy())
        assert env.state == pytest.approx(moved[name][0].numpy())
    hit, passed = moved["rail"][0], moved["free"][0]
    torch.testing.assert_close(moved["rail"][1], moved["free"][1])
    assert hit[0] == 0.4
    assert hit[1] == pytest.approx(-0.3 * passed[1])
    swing = -0.75 * passed[2].cos() / 0.5 * (hit[1] - passed[1])
    assert hit[3] == pytest.approx(passed[3] + swing)


def test_a_model_stops_with_its_own_constants_and_says_so_to_its_gradients():
    model = HybridDynamics.pure_prior(RAIL, constants={"half_length": 0.7}).double()
    action = torch.zeros(2, 1, dtype=torch.float64)
    compiled = torch.compile(lambda s: model.step(s, action), fullgraph=True, backend="eager")
    after = model.step(CRASH, action)
    torch.testing.assert_close(compiled(CRASH), after)
    torch.testing.assert_close(torch.func.vmap(model.step)(CRASH, action), after)
    again = copy.deepcopy(model)
    again.prior.log_constants.data[:] += 0.2
    assert not torch.allclose(again.step(CRASH, action)[0], after[0])
    torch.testing.assert_close(model.step(CRASH, action), after)
    after[0, 3].backward()
    gradient = dict(zip(model.prior.learned, model.prior.log_constants.grad, strict=True))
    assert gradient["half_length"] != 0


def test_a_data_driven_model_stops_the_cart_alone():
    model = HybridDynamics.data_driven(RAIL).double()
    beyond = torch.tensor([[0.9, 2.0, 0.4, 0.5]], dtype=torch.float64)
    assert model.step(beyond, torch.zeros(1, 1, dtype=torch.float64))[0, 0] == 0.4
    assert model.layout is RAIL.layout


def test_a_wall_of_somebody_elses_world_is_a_stop():
    class Car(System):
        state_names, action_names = ("x", "x_dot"), ("push",)
        velocity_of = {"x": "x_dot"}

        def prior(self, state, action, constants):  # in units of a step
            x, x_dot = state.unbind(-1)
            return torch.stack([x_dot, 0.0015 * action[..., 0] - 0.0025 * (3 * x).cos()], -1)

    layout, solve = (
        Car().layout({"x_dot": 0.07}, {"x": (-1.2, inf)}),
        make_integrator("semi_implicit_euler"),
    )
    env = MountainCar().unwrapped
    env.reset(seed=0)
    state, hits = torch.tensor([-0.9, -0.06], dtype=torch.float64), 0
    env.state = state.numpy()
    push = torch.full((1,), -1.0, dtype=torch.float64)
    for _ in range(120):
        state = solve(lambda s: Car().prior(s, push, {}), state, 1.0, layout)
        env.step(push.numpy())
        assert state.tolist() == pytest.approx(env.state.tolist(), abs=1e-5)
        hits += state[0].item() == -1.2
    assert hits > 0


def test_a_task_without_stops_has_the_layout_as_it_was():
    task = get_task("pendulum")
    assert not task.layout.stopped
    assert HybridDynamics.pure_prior(task).layout is task.layout
    assert Pendulum().layout() == task.layout
