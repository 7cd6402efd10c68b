"""Fits by multiple shooting: windows, derivatives, and what noise does to them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import DynamicsLoss, HybridDynamics, get_task
from phihp_torchrl.dynamics import FitConfig, fit
from phihp_torchrl.dynamics.shooting import Windows, _Shooting, cut_windows
from phihp_torchrl.trainers import CollectConfig, ModelConfig, ModelTrainer
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

TASK = get_task("pendulum")
NOISE = {"theta": 0.01, "theta_dot": 0.05}
MODEL = ModelConfig(
    real_steps=300,
    steps_per_iteration=300,
    hidden_sizes=(8,),
    integrator="semi_implicit_euler",
    fit=FitConfig(steps=10),
    collect=CollectConfig(
        planning_horizon=10, replan_every=5, num_candidates=16, top_k=4, optim_steps=1
    ),
)


def episodes(count: int = 6, steps: int = 25, noise: float = 0.0) -> TensorDict:
    """Transitions of a pendulum of another mass, in episodes of ``steps``, with noisy sensors."""
    generator = torch.Generator().manual_seed(0)
    truth = HybridDynamics.pure_prior(TASK, constants={"mass": 1.3})
    parts = []
    for _ in range(count):
        state = TASK.coverage.sample([1], generator=generator)
        actions = 4.0 * torch.rand(1, steps, 1, generator=generator) - 2.0
        states = torch.cat([state[:, None], truth.rollout(state, actions)], 1)[0]
        shown = states + noise * torch.randn(states.shape, generator=generator)
        seen = TASK.observe(shown)
        following = TensorDict(observation=seen[1:], batch_size=[steps])
        data = {"observation": seen[:-1], "action": actions[0], "next": following}
        parts.append(TensorDict(data, batch_size=[steps]))
    return torch.cat(parts).detach()


def test_windows_do_not_go_past_the_end_of_an_episode():
    loss = DynamicsLoss(HybridDynamics.pure_prior(TASK))
    windows = cut_windows(loss, episodes(count=2, steps=7), 5)
    assert windows.known.sum(1).tolist() == [6, 3, 6, 3]  # 5 steps and 2, twice
    data = episodes(count=2, steps=7)
    assert cut_windows(loss, data[torch.arange(14) != 3], 20).known.sum(1).tolist() == [4, 4, 8]


def test_derivatives_are_those_by_differences():
    torch.manual_seed(0)
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK, hidden_sizes=(3,))).double()
    problem = _Shooting(loss)
    windows = cut_windows(loss, episodes(count=1, steps=6).double(), 6)
    theta, starts = problem.vector.read(), windows.states[:, 0]
    paths = problem.paths(theta, starts, windows)
    along, through = problem._through(theta, paths, windows, parameters=True)
    step = 1e-6
    for i in range(len(theta)):
        moved = theta.clone()
        moved[i] += step
        slope = (problem.paths(moved, starts, windows) - paths) / step
        torch.testing.assert_close(along[..., i], slope, rtol=1e-3, atol=1e-5)
    for i in range(2):
        moved = starts.clone()
        moved[:, i] += step
        slope = (problem.paths(theta, moved, windows) - paths) / step
        torch.testing.assert_close(through[..., i], slope, rtol=1e-3, atol=1e-5)


def test_without_noise_it_finds_the_truth():
    data = episodes()
    loss = DynamicsLoss(HybridDynamics.pure_prior(TASK))
    report = fit(loss, data, data, FitConfig(method="multiple_shooting", steps=15))
    gains = TASK.system.identifiable(loss.dynamics.prior.constants())
    assert gains["torque_gain"].item() == pytest.approx(3.0 / 1.3, rel=1e-3)
    assert report.held_out_error < 1e-5


def test_a_window_that_diverges_does_not_stop_the_fit():
    data = episodes()
    data["observation"][3] = TASK.observe(torch.tensor([0.0, 1e4]))
    loss = DynamicsLoss(HybridDynamics.pure_prior(TASK))
    fit(loss, data, data, FitConfig(method="multiple_shooting", steps=10))
    assert all(p.isfinite().all() for p in loss.dynamics.parameters())


def test_steps_of_unequal_duration_are_integrated_as_such():
    data = episodes()
    data["time_step"] = torch.full([len(data), 1], TASK.time_step)
    loss = DynamicsLoss(HybridDynamics.pure_prior(TASK))
    windows = cut_windows(loss, data, 10)
    assert isinstance(windows, Windows)
    assert (windows.seconds == TASK.time_step).all()


def test_noise_does_not_bias_what_it_biases_in_one_step():
    data, found = episodes(count=40, noise=0.1), {}
    for method in ("levenberg_marquardt", "multiple_shooting"):
        loss = DynamicsLoss(HybridDynamics.pure_prior(TASK))
        fit(loss, data, data, FitConfig(method=method, steps=25, batch_size=None))
        gains = TASK.system.identifiable(loss.dynamics.prior.constants())
        found[method] = abs(gains["gravity_gain"].item() / (15.0 / 1.0) - 1.0)
    assert found["multiple_shooting"] < 0.02
    assert found["multiple_shooting"] < 0.5 * found["levenberg_marquardt"]


def test_noise_in_one_step_errors_is_told(caplog):
    for noise, told in ((NOISE, True), ({}, False)):
        caplog.clear()
        world = SimulatedWorld(TASK, SimulatedConfig(noise=noise))
        ModelTrainer(TASK, MODEL, seed=0, world=world).advance()
        assert ("model.fit.method=multiple_shooting" in caplog.text) == told


@pytest.mark.slow
def test_a_run_with_noisy_sensors_predicts_to_the_noise():
    world = SimulatedWorld(TASK, SimulatedConfig(noise=NOISE))
    fitting = FitConfig(method="multiple_shooting")
    config = replace(MODEL, real_steps=600, steps_per_iteration=600, fit=fitting)
    torch.manual_seed(0)
    trainer = ModelTrainer(TASK, config, seed=0, world=world)
    trainer.advance()
    generator = torch.Generator().manual_seed(1)
    visited = trainer.states()
    state = visited[torch.randint(len(visited), (200,), generator=generator)]
    actions = 4.0 * torch.rand(200, 20, 1, generator=generator) - 2.0
    truth = SimulatedWorld(TASK).oracle().rollout(state, actions)[:, -1]
    error = TASK.difference(truth, trainer.dynamics.rollout(state, actions)[:, -1])
    assert (error.square().mean(0).sqrt() < 2.0 * torch.tensor([0.01, 0.05])).all()
