"""Transitions that have a time step each: model, loss, rollouts and fits."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.dynamics import DynamicsLoss, FitConfig, fit, rollout_error

from .draws import draw

TASK = get_task("pendulum")


def data(dynamics: HybridDynamics, count: int = 200) -> TensorDict:
    state, action = draw(TASK, count)
    seconds = TASK.time_step * (0.2 + 2.0 * torch.rand(count, 1))
    with torch.no_grad():
        following = dynamics(state, action, seconds)
    return TensorDict(
        observation=TASK.observe(state),
        action=action,
        time_step=seconds,
        next=TensorDict(observation=TASK.observe(following), batch_size=[count]),
        batch_size=[count],
    )


def test_the_time_step_of_the_task_is_the_default() -> None:
    dynamics, (state, action) = HybridDynamics.hybrid(TASK), draw(TASK)
    same = torch.full((len(state), 1), TASK.time_step)
    assert torch.allclose(dynamics(state, action, same), dynamics(state, action), atol=1e-6)


@pytest.mark.parametrize(
    ("method", "integrator"),
    [
        ("levenberg_marquardt", "semi_implicit_euler"),
        ("levenberg_marquardt", "rk4"),
        ("adam", "semi_implicit_euler"),
    ],
)
def test_a_fit_takes_an_irregular_clock_as_it_is(integrator: str, method: str) -> None:
    truth = HybridDynamics.pure_prior(TASK, constants={"mass": 1.4}, integrator=integrator)
    model = HybridDynamics.pure_prior(TASK, integrator=integrator)
    rows = data(truth)
    loss = DynamicsLoss(model)
    steps = 20 if method == "levenberg_marquardt" else 500
    config = FitConfig(method=method, steps=steps, learning_rate=2e-2)
    fit(loss, rows[:150], rows[150:], config)
    found, true = (TASK.system.identifiable(d.prior.constants()) for d in (model, truth))
    for name, value in true.items():
        assert found[name].item() == pytest.approx(value.item(), rel=0.01), name
    blind = DynamicsLoss(HybridDynamics.pure_prior(TASK, integrator=integrator))
    report = fit(blind, rows[:150].exclude("time_step"), rows[150:].exclude("time_step"), config)
    assert report.held_out_error > 1e3 * loss(rows)["loss_prediction"]


def test_mini_batches_keep_the_time_steps_of_their_rows() -> None:
    truth = HybridDynamics.pure_prior(TASK, constants={"mass": 1.4})
    loss = DynamicsLoss(HybridDynamics.pure_prior(TASK))
    fit(loss, (rows := data(truth)), rows, FitConfig(steps=20, batch_size=32))
    assert loss(rows)["loss_prediction"] < 1e-6


def test_rollouts_use_the_time_steps_of_their_blocks() -> None:
    dynamics = HybridDynamics.hybrid(TASK)
    state, seconds = draw(TASK, 3)[0], 0.01 + 0.1 * torch.rand(3, 7, 1)
    actions = torch.rand(3, 7, 1)
    states = [state, *dynamics.rollout(state, actions, seconds).unbind(1)]
    observed = TASK.observe(torch.stack(states, 1))
    blocks = TensorDict(
        observation=observed[:, :-1],
        action=actions,
        time_step=seconds,
        next=TensorDict(observation=observed[:, 1:], batch_size=[3, 7]),
        batch_size=[3, 7],
    )
    assert rollout_error(DynamicsLoss(dynamics), blocks) < 1e-4
    assert rollout_error(DynamicsLoss(dynamics), blocks.exclude("time_step")) > 1e-2
