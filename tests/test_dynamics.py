"""The transition F^p + F^r: its four kinds, what each may know, and its shape as a world model."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.dynamics import (
    PhysicsPrior,
    ResidualMLP,
    TaskWorldModel,
    WorldPhysics,
    perturbed_constants,
)
from phihp_torchrl.integrators import Dopri5
from phihp_torchrl.systems import CartPole, Pendulum
from phihp_torchrl.tasks import list_tasks

TASKS = ["pendulum", "cartpole-swingup", "acrobot-swingup"]
INTEGRATORS = ["semi_implicit_euler", "rk4", "dopri5"]
FIXED_STEP = INTEGRATORS[:2]


def draw(task, count=16):
    state = (task.coverage or task.reset).sample([count])
    high = torch.tensor(task.action_high)
    return state, high * (2 * torch.rand(count, len(high)) - 1)


def frictionless(task):
    system = type(task.system)(friction_constants=dict.fromkeys(task.system.friction_constants, 0))
    return replace(task, system=system)


# The four kinds


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", TASKS)
def test_prior_with_true_constants_is_the_world_without_friction(name, integrator):
    task = frictionless(get_task(name))
    state, action = draw(task)
    predicted = HybridDynamics.pure_prior(task, integrator=integrator)(state, action)
    torch.testing.assert_close(
        predicted, task.step(state, action, integrator), rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("name", list_tasks())
def test_oracle_is_the_world(name):
    task = get_task(name)
    state, action = draw(task)
    oracle = HybridDynamics.oracle(task)
    assert torch.equal(oracle(state, action), task.step(state, action))
    assert list(oracle.parameters()) == []
    other = HybridDynamics.oracle(task, integrator="rk4")
    assert torch.equal(other(state, action), task.step(state, action, "rk4"))


def test_oracle_takes_the_integrator_of_its_task():
    task = replace(get_task("pendulum"), integrator="rk4")
    state, action = draw(task)
    assert torch.equal(HybridDynamics.oracle(task)(state, action), task.step(state, action))


@pytest.mark.parametrize("name", TASKS)
def test_prior_never_reads_friction(name):
    task = get_task(name)
    friction = {key: 7.0 for key in task.system.friction_constants}
    rough = replace(task, system=type(task.system)(friction_constants=friction))
    state, action = draw(task)
    assert not torch.equal(task.step(state, action), rough.step(state, action))
    for make in (HybridDynamics.pure_prior, HybridDynamics.hybrid):
        torch.manual_seed(0)
        smooth_model = make(task)
        torch.manual_seed(0)
        assert torch.equal(smooth_model(state, action), make(rough)(state, action))

    class Forbidden(type(task.system)):
        def friction(self, state, action):
            raise AssertionError("the model looked at the friction")

    HybridDynamics.hybrid(replace(task, system=Forbidden()))(state, action)


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
    assert isinstance(HybridDynamics.oracle(task).prior, WorldPhysics)
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
    world = replace(task, system=Pendulum(friction_constants={"joint": 1.0}))
    torch.testing.assert_close(dynamics(state, action), world.step(state, action))


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
        (lambda t: HybridDynamics(t, prior=None, residual=None), "prior, residual"),
        (lambda t: HybridDynamics.hybrid(t, integrator="euler"), "integrator"),
        (lambda t: HybridDynamics.hybrid(t, residual_outputs="some"), "residual_outputs"),
        (lambda t: HybridDynamics.hybrid(t, hidden_sizes=()), "hidden_sizes"),
        (lambda t: HybridDynamics.hybrid(t, hidden_sizes=(16, 0)), "hidden_sizes"),
        (lambda t: HybridDynamics.hybrid(t, constants={"height": 1.0}), "constants.*height"),
        (lambda t: HybridDynamics.pure_prior(t, constants={"mass": -1.0}), "constants.*positive"),
        (
            lambda t: HybridDynamics.pure_prior(t, constants={"mass": math.nan}),
            "constants.*positive",
        ),
    ],
)
def test_errors_name_what_is_wrong(build, message):
    with pytest.raises(ValueError, match=message):
        build(get_task("pendulum"))


# Properties of every transition


@pytest.mark.parametrize("integrator", FIXED_STEP)
@pytest.mark.parametrize("name", TASKS)
def test_full_turns_change_nothing(name, integrator):
    task = get_task(name)
    dynamics = HybridDynamics.hybrid(task, integrator=integrator).double()
    state, action = (part.double() for part in draw(task))
    turns = torch.zeros(task.system.state_dim, dtype=torch.float64)
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


@pytest.mark.parametrize("name", TASKS)
def test_actions_are_clipped(name):
    task = get_task(name)
    dynamics = HybridDynamics.hybrid(task)
    state, _ = draw(task)
    high = torch.tensor(task.action_high).expand(len(state), -1)
    assert torch.equal(dynamics(state, 10 * high), dynamics(state, high))
    assert torch.equal(dynamics(state, -10 * high), dynamics(state, -high))


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


@pytest.mark.parametrize("integrator", FIXED_STEP)
@pytest.mark.parametrize("name", TASKS)
def test_a_transition_is_one_graph(name, integrator):
    task = get_task(name)
    dynamics = HybridDynamics.hybrid(task, integrator=integrator)
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
    one.residual.set_scales(state, action, task.system.derivative(state, action))
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


# Parts


def test_constants_stay_positive():
    prior = PhysicsPrior(CartPole(), constants={"pole_mass": 1e-3})
    guess = [value.item() for value in prior.constants().values()]
    optimizer = torch.optim.SGD(prior.parameters(), lr=0.5)
    for _ in range(5):
        optimizer.zero_grad()
        torch.stack(list(prior.constants().values())).sum().backward()
        optimizer.step()
    assert all(
        0 < value < start for value, start in zip(prior.constants().values(), guess, strict=True)
    )


def test_constants_that_are_known_are_not_learned():
    prior = PhysicsPrior(Pendulum(), {"mass": 1.3}, learnable=False)
    assert list(prior.parameters()) == []
    assert "log_constants" in prior.state_dict()
    assert prior.constants()["mass"].item() == pytest.approx(1.3)


def test_prior_starts_from_the_constants_of_its_system():
    system = Pendulum(constants={"length": 2.0})
    assert PhysicsPrior(system).constants()["length"].item() == pytest.approx(2.0)


def test_perturbed_constants():
    system = CartPole()
    guess = perturbed_constants(system, 0.3, torch.Generator().manual_seed(0))
    for name, value in system.constants.items():
        assert abs(guess[name] / value - 1) == pytest.approx(0.3)
    again = perturbed_constants(system, 0.3, torch.Generator().manual_seed(0))
    assert guess == again
    seen = {
        tuple(perturbed_constants(system, 0.3, torch.Generator().manual_seed(seed)).values())
        for seed in range(50)
    }
    assert len(seen) > 8, "signs are drawn for each constant by itself"
    assert perturbed_constants(system, 0.0) == system.constants


@pytest.mark.parametrize("error", [-0.1, 1.0, math.nan])
def test_perturbed_constants_stay_positive(error):
    with pytest.raises(ValueError, match="error"):
        perturbed_constants(Pendulum(), error)


def test_residual_scales_make_inputs_and_outputs_of_unit_size():
    task = get_task("cartpole-swingup")
    residual = ResidualMLP(task.system, outputs=(1, 3))
    state, action = draw(task, 500)
    derivative = task.system.derivative(state, action)
    residual.set_scales(state, action, derivative)
    inputs = torch.cat([task.system.observe(state), action], -1) * residual.input_scale
    torch.testing.assert_close(inputs.square().mean(0), torch.ones(inputs.shape[1]))
    torch.testing.assert_close(residual.output_scale, derivative[:, [1, 3]].std(0))


def test_residual_scales_of_too_few_or_equal_transitions_are_finite():
    residual = ResidualMLP(Pendulum())
    for count in (1, 5):
        residual.set_scales(torch.zeros(count, 2), torch.zeros(count, 1), torch.zeros(count, 2))
        assert residual(torch.zeros(1, 2), torch.zeros(1, 1)).isfinite().all()


# The world model


@pytest.mark.parametrize("batch", [[], [4], [2, 3]])
@pytest.mark.parametrize("name", list_tasks())
def test_both_interfaces_of_the_world_model_agree(name, batch):
    task = get_task(name)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    state = (task.coverage or task.reset).sample(batch)
    action = 3 * torch.tensor(task.action_high) * torch.randn(*batch, task.system.action_dim)
    observation = model.observe(state)
    result = model(TensorDict(observation=observation, action=action, batch_size=batch))
    state = model.locate(observation)
    next_state, reward, terminated = model.transition(state, action)
    assert reward.shape == terminated.shape == torch.Size(batch)
    assert terminated.dtype == torch.bool
    assert torch.equal(result["state"], state)
    assert torch.equal(result["next", "state"], next_state)
    assert torch.equal(result["next", "reward"], reward.unsqueeze(-1))
    assert torch.equal(result["next", "terminated"], terminated.unsqueeze(-1))
    assert torch.equal(result["next", "observation"], model.observe(next_state))


def test_reward_is_of_the_clipped_action():
    task = get_task("pendulum")
    model = TaskWorldModel(task, HybridDynamics.oracle(task))
    _, reward, _ = model.transition(torch.zeros(1, 2), torch.full((1, 1), 50.0))
    assert reward.item() == pytest.approx(-0.001 * 2.0**2)


def test_only_the_dynamics_are_learned():
    task = get_task("cartpole")
    dynamics = HybridDynamics.hybrid(task)
    ours = {id(parameter) for parameter in TaskWorldModel(task, dynamics).parameters()}
    assert ours == {id(parameter) for parameter in dynamics.parameters()}
