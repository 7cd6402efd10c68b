"""The truths of the paper's worlds: their friction, by energies and by the published equations."""

from __future__ import annotations

import pytest
import torch
from physics import ENERGY, PUBLISHED, SYSTEMS, action_power, all_systems, random_transition

from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.systems import Acrobot, CartPole, ElbowAcrobot, Pendulum
from phihp_torchrl.worlds import Plant, find_plant
from phihp_torchrl.worlds.simulated.plants import AcrobotPlant, CartPolePlant, PendulumPlant


def frictionless(kind):
    plant = find_plant(kind())
    return find_plant(kind(), coefficients=dict.fromkeys(plant.coefficients, 0.0))


def friction_power(plant: Plant, state):
    """Rate at which friction takes energy away."""
    b = plant.coefficients
    if isinstance(plant, PendulumPlant):  # b is on 3 times the torque: the published equation
        return b["joint"] * state[..., 1] ** 2 / 3
    if isinstance(plant, CartPolePlant):
        return b["cart"] * state[..., 1].abs() + b["pole"] * state[..., 3] ** 2
    return b["joint1"] * state[..., 2] ** 2 + b["joint2"] * state[..., 3] ** 2


@all_systems
def test_work_of_the_action_less_friction_is_the_change_of_energy(kind):
    plant = find_plant(kind())
    state, action = random_transition(plant.system)
    _, rate = torch.func.jvp(
        lambda s: ENERGY[kind](s, plant.constants), (state,), (plant.derivative(state, action),)
    )
    expected = action_power(plant.system, state, action) - friction_power(plant, state)
    torch.testing.assert_close(rate, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("integrator", ["rk4", "dopri5"])
@all_systems
def test_energy_is_conserved_without_friction_and_falls_with_it(kind, integrator):
    solve = make_integrator(integrator)
    for plant, has_friction in ((frictionless(kind), False), (find_plant(kind()), True)):
        state, action = random_transition(plant.system, n=8)
        idle, layout = torch.zeros_like(action), plant.system.layout()
        energies = [ENERGY[kind](state, plant.constants)]
        for _ in range(50):
            state = solve(lambda s: plant.derivative(s, idle), state, 0.01, layout)  # noqa: B023
            energies.append(ENERGY[kind](state, plant.constants))
        energy = torch.stack(energies)
        if has_friction:
            assert (energy.diff(dim=0) < 0).all()
        else:
            torch.testing.assert_close(energy, energy[0].expand_as(energy), rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("scale", [1.0, 1.3])
@all_systems
def test_the_derivative_is_the_published_equation(kind, scale):
    declared = find_plant(kind())
    plant = find_plant(
        kind(),
        {name: scale * value for name, value in declared.constants.items()},
        {name: scale * value for name, value in declared.coefficients.items()},
    )
    state, action = random_transition(plant.system)
    expected = [
        PUBLISHED[kind](s, a, plant.constants, plant.coefficients)
        for s, a in zip(state.tolist(), action.tolist(), strict=True)
    ]
    torch.testing.assert_close(
        plant.derivative(state, action), torch.tensor(expected, dtype=torch.float64)
    )


@all_systems
def test_zero_friction_leaves_the_prior(kind):
    plant = frictionless(kind)
    state, action = random_transition(plant.system)
    prior = plant.system.prior(state, action, plant.constants)
    torch.testing.assert_close(plant.derivative(state, action), prior)
    assert (plant.friction(state, action) == 0).all()


@all_systems
def test_friction_does_not_read_the_action(kind):
    plant = find_plant(kind())
    state, action = random_transition(plant.system)
    assert torch.equal(plant.friction(state, action), plant.friction(state, -2 * action))


def test_the_coefficients_are_the_published_ones():
    assert find_plant(Pendulum()).coefficients == {"joint": 0.5}
    assert find_plant(CartPole()).coefficients == {"cart": 0.1, "pole": 0.02}
    for arm in (Acrobot(), ElbowAcrobot()):
        assert find_plant(arm).coefficients == {"joint1": 0.01, "joint2": 0.05}


def test_the_true_constants_are_the_systems_first_guesses():
    for kind in SYSTEMS:
        assert find_plant(kind()).constants == kind().constants
    assert find_plant(Pendulum({"mass": 2.0})).constants["mass"] == 2.0


def test_each_system_has_its_plant():
    kinds = {Pendulum: PendulumPlant, CartPole: CartPolePlant, Acrobot: AcrobotPlant}
    for system, plant in {**kinds, ElbowAcrobot: AcrobotPlant}.items():
        assert type(find_plant(system())) is plant


def test_a_full_arm_with_an_idle_hinge_is_the_elbow_acrobot():
    state, action = random_transition(ElbowAcrobot())
    both = torch.cat([torch.zeros_like(action), action], -1)
    torch.testing.assert_close(
        find_plant(Acrobot()).derivative(state, both),
        find_plant(ElbowAcrobot()).derivative(state, action),
    )


@pytest.mark.parametrize("batch", [(), (3,), (2, 0), (2, 3, 4)])
@all_systems
def test_any_leading_batch_dimensions(kind, batch):
    plant = find_plant(kind())
    system = plant.system
    state, action = torch.randn(*batch, system.state_dim), torch.randn(*batch, system.action_dim)
    for value in (plant.derivative(state, action), plant.friction(state, action)):
        assert value.shape == state.shape
        assert value.dtype == state.dtype


@all_systems
def test_full_turns_change_nothing(kind):
    plant = find_plant(kind())
    state, action = random_transition(plant.system)
    turned = state.clone()
    turned[:32, list(plant.system.angle_indices)] += 2 * torch.pi
    turned[32:, list(plant.system.angle_indices)] -= 4 * torch.pi
    torch.testing.assert_close(
        plant.derivative(turned, action), plant.derivative(state, action), rtol=1e-9, atol=1e-9
    )
