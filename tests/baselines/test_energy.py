"""Energy shaping: energies are those of the equations, and pendulums come up and stay."""

from __future__ import annotations

import pytest
import torch

from phihp_torchrl import ConfigError, HybridDynamics, get_task
from phihp_torchrl.baselines import EnergyShaping, PumpConfig
from phihp_torchrl.baselines.energy import find_energy
from phihp_torchrl.integrators import RK4

from .parts import Slider, play, prior_of, task_of


@pytest.mark.parametrize("name", ["pendulum-swingup", "acrobot", "acrobot-swingup"])
def test_energy_is_kept_without_action_and_its_power_is_its_slope(name: str) -> None:
    task = get_task(name)
    dynamics = HybridDynamics.pure_prior(task, integrator=RK4(8))
    found = find_energy(task, dynamics)
    assert found is not None
    energy, constants = found
    generator = torch.Generator().manual_seed(3)
    state = task.coverage.sample([64], generator=generator, dtype=torch.float64)
    state[:, task.system.velocity_indices] *= 0.3
    action = torch.zeros(64, task.action_dim, dtype=torch.float64)
    dynamics = dynamics.double()
    with torch.no_grad():
        later = dynamics.step(state, action, torch.full((64, 1), 0.01, dtype=torch.float64))
    before, after = energy.height(state, constants), energy.height(later, constants)
    torch.testing.assert_close(after, before, atol=1e-5, rtol=0)

    state.requires_grad_()
    (slope,) = torch.autograd.grad(energy.height(state, constants).sum(), state)
    with torch.no_grad():
        power = energy.power(state, constants)[:, -task.action_dim :]
        for j in range(task.action_dim):
            push = torch.zeros_like(action)
            push[:, j] = 1.0
            force = dynamics.derivative(state, push) - dynamics.derivative(state, action)
            ratio = (slope * force).sum(-1) / power[:, j]
            torch.testing.assert_close(ratio, ratio[:1].expand_as(ratio), rtol=1e-3, atol=1e-6)
            assert ratio[0] > 0


def test_it_swings_a_pendulum_up_and_keeps_it_there() -> None:
    task = get_task("pendulum-swingup")
    dynamics = HybridDynamics.pure_prior(task)
    start = task.reset.sample([3], generator=torch.Generator().manual_seed(1))
    states = play(EnergyShaping.from_model(task, dynamics), task, start, 160, dynamics)
    assert (states[-40:, :, 0].cos() > 0.98).all()


def test_it_swings_a_pole_on_a_cart_past_upright() -> None:
    task = get_task("cartpole-swingup")
    dynamics = HybridDynamics.pure_prior(task)
    start = task.reset.sample([3], generator=torch.Generator().manual_seed(1))
    states = play(EnergyShaping.from_model(task, dynamics), task, start, 250, dynamics)
    assert (states[..., 2].cos() > 0.98).any(0).all()
    assert states[..., 0].abs().max() < 3.5  # the cart comes back while the pole is caught


def test_it_brings_the_tip_of_an_elbow_driven_arm_to_its_height() -> None:
    task = get_task("acrobot")
    dynamics = HybridDynamics.pure_prior(task)
    start = task.reset.sample([4], generator=torch.Generator().manual_seed(1))
    controller = EnergyShaping.from_model(task, dynamics)
    assert controller.lqr is None
    states = play(controller, task, start, 250, dynamics)
    assert task.is_terminated(states).any(0).all()


def test_it_refuses_what_has_no_energy() -> None:
    task = task_of(Slider())
    with pytest.raises(ConfigError, match=r"dynamics: .* CartPole or Acrobot, got .*Slider"):
        EnergyShaping.from_model(task, prior_of(task))
    task = get_task("pendulum")
    with pytest.raises(ConfigError, match="dynamics: expected a model with constants"):
        EnergyShaping.from_model(task, HybridDynamics.data_driven(task))
    with pytest.raises(ConfigError, match="cart_reach: expected a positive number"):
        PumpConfig(cart_reach=0.0)
