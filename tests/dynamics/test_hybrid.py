"""The transition F^p + F^r: its kinds, what each may know, and what holds for all of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch
from lopsided import LOPSIDED
from torch import nn

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import PhysicsPrior, TaskWorldModel
from phihp_torchrl.integrators import RK4, Dopri5
from phihp_torchrl.systems import System
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld, find_plant

from .draws import draw

TASKS = ["pendulum", "cartpole-swingup", "acrobot-swingup"]
INTEGRATORS = ["semi_implicit_euler", "rk4", "dopri5"]
FIXED_STEP = INTEGRATORS[:2]


# The kinds


@pytest.mark.parametrize("name", TASKS)
def test_parts_add_up(name):
    task = get_task(name)
    hybrid = HybridDynamics.hybrid(task)
    state, action = draw(task)
    total = hybrid.prior(state, action) + hybrid.residual(state, action)
    assert torch.equal(hybrid.derivative(state, action), total)
    for parts in (
        {"prior": hybrid.prior, "residual": None},
        {"prior": None, "residual": hybrid.residual},
    ):
        alone = HybridDynamics(task, **parts)
        part = parts["prior"] or parts["residual"]
        assert torch.equal(alone.derivative(state, action), part(state, action))


def test_kinds_have_the_parts_they_are_named_for():
    task = get_task("cartpole")
    data_driven = HybridDynamics.data_driven(task, hidden_sizes=(8,))
    assert data_driven.prior is None
    assert data_driven.residual.outputs == (0, 1, 2, 3), "nothing is known, so all must be learned"
    assert HybridDynamics.pure_prior(task).residual is None
    hybrid = HybridDynamics.hybrid(task, constants={"cart_mass": 2.0})
    assert hybrid.prior.constants()["cart_mass"].item() == pytest.approx(2.0)
    assert hybrid.prior.constants()["gravity"].item() == pytest.approx(9.8)


def test_any_module_may_be_a_part():
    class Brake(nn.Module):
        def forward(self, state, action):
            return torch.stack([torch.zeros_like(state[:, 0]), -state[:, 1]], -1)

    task = get_task("pendulum")
    dynamics = HybridDynamics(task, prior=PhysicsPrior(task.system), residual=Brake())
    state, action = draw(task)
    world = SimulatedWorld(task, SimulatedConfig(friction={"joint": 1.0}))
    torch.testing.assert_close(dynamics(state, action), world.step(state, action))
    with pytest.raises(ConfigError, match=r"^residual: expected a part that says how .*got Brake"):
        _ = dynamics.config


def test_a_model_cannot_look_at_the_friction(monkeypatch):
    def look(*_):
        raise AssertionError("the model looked at the truth")

    for name in TASKS:
        task = get_task(name)
        plant = type(find_plant(task.system))
        monkeypatch.setattr(plant, "friction", look)
        monkeypatch.setattr(plant, "derivative", look)
        state, action = draw(task)
        for make in (HybridDynamics.pure_prior, HybridDynamics.hybrid, HybridDynamics.data_driven):
            assert make(task)(state, action).isfinite().all()
        with pytest.raises(AssertionError, match="looked at the truth"):
            SimulatedWorld(task).step(state, action)


def test_residual_outputs():
    task = get_task("cartpole")
    state, action = draw(task)
    some = HybridDynamics.hybrid(task).residual(state, action)
    assert (some[:, [0, 2]] == 0).all()
    assert (some[:, [1, 3]] != 0).any(0).all()
    every = HybridDynamics.hybrid(task, residual_outputs="all").residual(state, action)
    assert (every != 0).any(0).all()


def test_positions_follow_velocities_whatever_the_residual_says():
    task = get_task("cartpole-swingup")
    state, action = draw(task)
    new = HybridDynamics.hybrid(task)(state, action)
    torch.testing.assert_close(new[:, 0], state[:, 0] + task.time_step * new[:, 1])
    torch.testing.assert_close(new[:, 2], state[:, 2] + task.time_step * new[:, 3])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda t: HybridDynamics(t, prior=None, residual=None), "prior, residual: "),
        (lambda t: HybridDynamics.hybrid(t, integrator="euler"), "integrator: "),
        (lambda t: HybridDynamics.hybrid(t, residual_outputs="some"), "residual_outputs: "),
        (lambda t: HybridDynamics.hybrid(t, hidden_sizes=()), "hidden_sizes: "),
        (lambda t: HybridDynamics.hybrid(t, hidden_sizes=(16, 0)), "hidden_sizes: "),
        (lambda t: HybridDynamics.hybrid(t, constants={"height": 1.0}), "constants: .*height"),
        (
            lambda t: HybridDynamics.pure_prior(t, constants={"mass": -1.0}),
            r"constants\.mass: expected a value between 0\.0 and inf, got -1",
        ),
        (
            lambda t: HybridDynamics.pure_prior(t, constants={"mass": math.nan}),
            r"constants\.mass: expected finite",
        ),
        (lambda t: HybridDynamics.hybrid(t, activation=nn.Identity), "activation: expected one of"),
    ],
)
def test_errors_name_what_is_wrong(build, message):
    with pytest.raises(ConfigError, match=f"^{message}"):
        build(get_task("pendulum"))


# Built again from what it says of itself


BUILDERS = {
    "hybrid": lambda t: HybridDynamics.hybrid(t, hidden_sizes=(8, 4), activation=nn.ReLU),
    "all outputs": lambda t: HybridDynamics.hybrid(t, residual_outputs="all", integrator=RK4(3)),
    "data_driven": lambda t: HybridDynamics.data_driven(t, integrator="rk4"),
    "pure_prior": lambda t: HybridDynamics.pure_prior(t, integrator=Dopri5(rtol=1e-3)),
    "oracle": lambda t: SimulatedWorld(t, SimulatedConfig(friction={"joint": 0.1})).oracle(),
}


@pytest.mark.parametrize("kind", BUILDERS)
def test_a_model_is_built_again_from_its_config_and_weights(kind):
    task = get_task("pendulum")
    torch.manual_seed(1)
    model = BUILDERS[kind](task)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1)
    config = json.loads(json.dumps(model.config))
    again = HybridDynamics.from_config(task, config)
    assert again.config == model.config
    again.load_state_dict(model.state_dict())
    state, action = draw(task)
    assert torch.equal(again(state, action), model(state, action))


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("prior", {"kind": "magic"}, "prior: expected one of .*'magic'"),
        ("integrator", {"name": "magic"}, "integrator: expected one of .*'magic'"),
        ("integrator", {"name": "rk4", "rtol": 1.0}, "integrator: 'rk4' has no such settings"),
    ],
)
def test_what_cannot_be_built_again_is_named(part, value, message):
    task = get_task("pendulum")
    config = {**HybridDynamics.hybrid(task).config, part: value}
    with pytest.raises(ConfigError, match=f"^{message}"):
        HybridDynamics.from_config(task, config)


class Unknown(System):
    """A system without equations."""

    state_names, action_names = ("x", "v"), ("force",)
    velocity_of = {"x": "v"}


def test_a_system_without_equations_is_learned_from_data_alone():
    task = replace(get_task("pendulum"), name="unknown", system=Unknown())
    state, action = draw(task)
    assert HybridDynamics.data_driven(task)(state, action).shape == state.shape
    with pytest.raises(NotImplementedError, match="Unknown: this system has no prior"):
        HybridDynamics.hybrid(task)(state, action)


# Properties of every transition


@pytest.mark.parametrize("integrator", FIXED_STEP)
@pytest.mark.parametrize("name", TASKS)
def test_full_turns_change_nothing(name, integrator):
    task = get_task(name)
    dynamics = HybridDynamics.hybrid(task, integrator=integrator).double()
    state, action = (part.double() for part in draw(task))
    turns = torch.zeros(task.state_dim, dtype=torch.float64)
    turns[list(task.system.angle_indices)] = 2 * torch.pi
    turned = dynamics(state + 2 * turns, action)
    torch.testing.assert_close(turned - 2 * turns, dynamics(state, action), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", TASKS)
def test_splitting_a_batch_changes_nothing(name, integrator):
    task = get_task(name)
    dynamics = HybridDynamics.hybrid(task, integrator=integrator)
    state, action = draw(task, 12)
    whole = dynamics(state, action)
    parts = [dynamics(s, a) for s, a in zip(state.split(5), action.split(5), strict=True)]
    tolerance = 1e-4 if integrator == "dopri5" else 1e-6  # it steps by the worst error in a batch
    torch.testing.assert_close(torch.cat(parts), whole, rtol=tolerance, atol=tolerance)
    nested = dynamics(state.reshape(3, 4, -1), action.reshape(3, 4, -1))
    torch.testing.assert_close(nested.reshape(12, -1), whole, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize(
    "task",
    [
        *map(get_task, TASKS),
        LOPSIDED,
        replace(LOPSIDED, action_low=(0.0,), action_high=(100.0,)),
    ],
    ids=["pendulum", "cartpole", "acrobot", "lopsided", "percent"],
)
def test_actions_are_clipped(task):
    dynamics = HybridDynamics.hybrid(task)
    state, _ = draw(task)
    low, high = (limit.expand(len(state), -1) for limit in task.bounds[:2])
    assert torch.equal(dynamics(state, high + 1000), dynamics(state, high))
    assert torch.equal(dynamics(state, low - 1000), dynamics(state, low))
    assert not torch.equal(dynamics(state, low), dynamics(state, high))
    assert torch.equal(dynamics.step(state, high), dynamics(state, high))


def test_velocity_limits_hold():
    task = get_task("acrobot")
    _, action = draw(task)
    fast = torch.tensor([0.0, 0.0, 100.0, -100.0]).expand(len(action), -1)
    new = HybridDynamics.hybrid(task)(fast, action)
    assert (new[:, 2].abs() <= 4 * math.pi + 1e-5).all()
    assert (new[:, 3].abs() <= 9 * math.pi + 1e-5).all()


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", TASKS)
def test_gradients_reach_every_parameter(name, integrator):
    task = get_task(name)
    solver = Dopri5(rtol=1e-4, atol=1e-5) if integrator == "dopri5" else integrator
    dynamics = HybridDynamics.hybrid(task, residual_outputs="all", integrator=solver)
    state, action = draw(task)
    dynamics(state, action).square().sum().backward()
    for parameter_name, parameter in dynamics.named_parameters():
        assert parameter.grad.isfinite().all(), parameter_name
        assert parameter.grad.abs().max() > 0, parameter_name
    gradient = dynamics.prior.log_constants.grad
    assert (gradient != 0).sum() >= 2, "constants that matter get a gradient each"


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_gradient_of_a_constant_by_differences(integrator):
    task = get_task("pendulum")
    state, action = (part.double() for part in draw(task))
    dynamics = HybridDynamics.pure_prior(task, integrator=integrator).double()

    def loss(logarithms):
        return torch.func.functional_call(
            dynamics, {"prior.log_constants": logarithms}, (state, action)
        ).sum()

    start = dynamics.prior.log_constants.detach()
    gradient = torch.autograd.grad(loss(start.requires_grad_()), start)[0]
    with torch.no_grad():
        for i, step in enumerate(1e-4 * torch.eye(3, dtype=torch.float64)):
            difference = (loss(start + step) - loss(start - step)) / 2e-4
            assert gradient[i].item() == pytest.approx(difference.item(), rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("name", TASKS)
def test_a_transition_is_one_graph(name):
    """By whichever integrator: those are compiled in tests of their own."""
    task = get_task(name)
    dynamics = HybridDynamics.hybrid(task)
    model = TaskWorldModel(task, dynamics)
    state, action = draw(task, 4)
    compiled = torch.compile(model.transition, fullgraph=True, backend="eager")
    for one, other in zip(compiled(state, action), model.transition(state, action), strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_kept(dtype):
    task = get_task("cartpole")
    state, action = (part.to(dtype) for part in draw(task))
    assert HybridDynamics.hybrid(task).to(dtype)(state, action).dtype == dtype


def test_state_dict_round_trip():
    task = get_task("cartpole")
    one, other = (
        HybridDynamics.hybrid(task),
        HybridDynamics.hybrid(task, constants={"gravity": 5.0}),
    )
    state, action = draw(task)
    rate = find_plant(task.system).derivative(state, action)
    one.residual.set_scales(state, action, rate)
    other.load_state_dict(one.state_dict())
    assert torch.equal(one(state, action), other(state, action))


# What is measured of it


@pytest.mark.parametrize("name", TASKS)
def test_residual_share(name):
    task = get_task(name)
    state, action = draw(task)
    hybrid = HybridDynamics.hybrid(task)
    prior, residual = hybrid.prior(state, action).norm(), hybrid.residual(state, action).norm()
    share = hybrid.residual_share(state, action)
    assert share.item() == pytest.approx((residual / (prior + residual)).item())
    assert 0 < share < 1
    assert HybridDynamics.data_driven(task).residual_share(state, action) == 1
    assert HybridDynamics.pure_prior(task).residual_share(state, action) == 0


def test_residual_share_where_nothing_moves():
    task = get_task("pendulum")
    at_rest, no_action = torch.zeros(3, 2), torch.zeros(3, 1)
    assert HybridDynamics.pure_prior(task).residual_share(at_rest, no_action) == 0


@pytest.mark.parametrize("batch", [[], [3], [2, 3]])
def test_rollout_is_repeated_steps(batch):
    task = get_task("acrobot-swingup")
    dynamics = HybridDynamics.hybrid(task)
    state = task.reset.sample(batch)
    actions = 2 * torch.rand(*batch, 5, 2) - 1
    states = dynamics.rollout(state, actions)
    assert states.shape == (*batch, 5, 4)
    assert not states.requires_grad
    for t in range(5):
        state = dynamics(state, actions[..., t, :])
        assert torch.equal(states[..., t, :], state)
