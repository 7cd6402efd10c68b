"""TD3's equations: targets, losses and Adam by hand and by explicit sums."""

from __future__ import annotations

import math

import pytest
import torch
from lopsided import LOPSIDED
from tensordict import TensorDict
from torchrl.objectives.value import TD0Estimator

from phihp_torchrl import get_task
from phihp_torchrl.agents import TD3Update, act, make_td3_loss
from phihp_torchrl.agents.equations import (
    actor_loss,
    adam_,
    adam_rates,
    critic_loss,
    q_values,
    soft_update_,
    td3_target,
)
from phihp_torchrl.imagination import Batch
from phihp_torchrl.tasks import ActionBounds

from .td3_parts import SMALL, make_batch, make_model, make_update


def test_functional_networks_are_the_modules():
    loss = make_td3_loss(make_model("cartpole"), SMALL)
    update = TD3Update(loss, make_model("cartpole"), SMALL)
    observation, action = torch.randn(7, 5), torch.randn(7, 1)
    with loss.actor_network_params.to_module(loss.actor_network):
        expected = loss.actor_network(TensorDict(observation=observation))["action"]
    bounds = make_model("cartpole").task.bounds
    torch.testing.assert_close(act(update.actor, observation, bounds), expected)
    values = q_values(update.critics, observation, action, bounds)
    assert values.shape == (2, 7)
    for i in range(2):
        with loss.qvalue_network_params[i].to_module(loss.qvalue_network):
            data = TensorDict(observation=observation, action=action)
            expected = loss.qvalue_network(data)["state_action_value"][:, 0]
        torch.testing.assert_close(values[i], expected)


# Targets by hand.

BOUNDS = ActionBounds.from_limits([-2.0], [2.0])
# Networks without hidden layers: action 2 tanh(b), Q_j = w_j . (observation, action / 2) + b_j.
FLAT_ACTOR = [torch.zeros(1, 3), torch.tensor([0.5])]
FLAT_CRITICS = [
    torch.tensor([[[0.0, 0.0, 1.0, 2.0]], [[0.0, 0.0, 0.0, 1.0]]]),
    torch.tensor([[10.0], [11.0]]),
]


def hand_batch():
    return Batch(
        state=torch.zeros(3, 2),
        action=torch.zeros(3, 1),
        reward=torch.tensor([1.0, 2.0, 3.0]),
        next_state=torch.tensor([[0.0, 1.0], [0.0, -5.0], [0.0, 1.0]]),
        terminated=torch.tensor([False, False, True]),
    )


def observe(state):
    return get_task("pendulum").observe(state)


def target(batch, noise, bounds=BOUNDS, **options):
    options = {"gamma": 0.9, "observe": observe, **options}
    return td3_target(batch, FLAT_ACTOR, FLAT_CRITICS, noise, bounds, **options)


def test_target_by_hand():
    a = math.tanh(0.5)
    first = 1.0 + 0.9 * min(10 + 1 + 2 * a, 11 + a)
    second = 2.0 + 0.9 * min(10 - 5 + 2 * a, 11 + a)
    values = target(hand_batch(), torch.zeros(3, 1))
    assert values.tolist() == pytest.approx([first, second, 3.0], rel=1e-6)


def test_target_action_is_noisy_and_clipped():
    a = math.tanh(0.5)
    values = target(hand_batch(), torch.tensor([[0.2], [100.0], [0.0]]))
    # 0.2 N·m are 0.1 of the bound; 100 N·m end at the bound itself.
    assert values[0].item() == pytest.approx(1.0 + 0.9 * min(11 + 2 * (a + 0.1), 11 + a + 0.1))
    assert values[1].item() == pytest.approx(2.0 + 0.9 * min(5 + 2 * 1.0, 12.0))


def test_target_within_lopsided_bounds():
    """From -6 to 12 the middle is 3 and the half-range 9; noise is in physical units."""
    bounds = ActionBounds.from_limits([-6.0], [12.0])
    a = math.tanh(0.5)
    assert act(FLAT_ACTOR, torch.zeros(1, 3), bounds).item() == pytest.approx(3 + 9 * a)
    values = target(hand_batch(), torch.tensor([[0.9], [100.0], [-100.0]]), bounds)
    assert values[0].item() == pytest.approx(1.0 + 0.9 * min(11 + 2 * (a + 0.1), 11 + a + 0.1))
    assert values[1].item() == pytest.approx(2.0 + 0.9 * min(5 + 2 * 1.0, 12.0))
    low = target(
        hand_batch()._replace(terminated=torch.zeros(3, dtype=torch.bool)),
        torch.full((3, 1), -100.0),
        bounds,
    )
    assert low[0].item() == pytest.approx(1.0 + 0.9 * min(11 - 2 * 1.0, 11 - 1.0))


@pytest.mark.parametrize("task", ["pendulum", "cartpole", LOPSIDED])
def test_expansion_is_the_explicit_sum(task):
    update = make_update(SMALL, task)
    model, gamma, steps = update.world_model, 0.9, 3
    bounds = model.task.bounds
    batch = make_batch(model, 32)
    batch = batch._replace(next_state=model.task.reset.sample([32]) * 3)  # some will fall
    noise = 0.1 * torch.randn(32, model.task.action_dim)
    actor, critics = update.actor, update.critics
    values = td3_target(
        batch, actor, critics, noise, bounds, gamma, model.observe, model.transition, steps
    )
    for i in range(32):
        expected, discount = batch.reward[i].item(), gamma
        state, alive = batch.next_state[i : i + 1], not batch.terminated[i]
        for _ in range(steps - 1):
            if alive:
                action = act(actor, model.observe(state), bounds)
                state, reward, terminated = model.transition(state, action)
                expected += discount * reward.item()
                discount *= gamma
                alive = not terminated.item()
        if alive:
            observation = model.observe(state)
            action = bounds.clip(act(actor, observation, bounds) + noise[i])
            expected += discount * q_values(critics, observation, action, bounds).min().item()
        assert values[i].item() == pytest.approx(expected, rel=1e-4, abs=1e-4)
    fewer = td3_target(batch, actor, critics, noise, bounds, gamma, model.observe)
    assert not torch.allclose(values, fewer)


def test_expansion_is_torchrls_return_of_several_steps():
    update = make_update()
    model, gamma, k = update.world_model, 0.9, 3
    bounds = model.task.bounds
    batch = make_batch(model, 16)._replace(terminated=torch.zeros(16, dtype=torch.bool))
    total, state = batch.reward.clone(), batch.next_state
    for i in range(1, k):
        action = act(update.actor, model.observe(state), bounds)
        state, reward, _ = model.transition(state, action)
        total += gamma**i * reward
    observation = model.observe(state)
    action = act(update.actor, observation, bounds)
    # What TorchRL's MultiStep transform would have made of k real steps.
    ended = torch.zeros(16, 1, dtype=torch.bool)
    following = TensorDict(
        reward=total.unsqueeze(-1), done=ended, terminated=ended, batch_size=[16]
    )
    steps = torch.full((16, 1), k)
    data = TensorDict(next=following, steps_to_next_obs=steps, batch_size=[16])
    expected = TD0Estimator(gamma=gamma, value_network=None).value_estimate(
        data, next_value=q_values(update.critics, observation, action, bounds).amin(0).unsqueeze(-1)
    )
    values = td3_target(
        batch, update.actor, update.critics, torch.zeros(16, 1), bounds, gamma,
        model.observe, model.transition, k,
    )  # fmt: skip
    torch.testing.assert_close(values, expected.squeeze(-1))


def test_expansion_needs_a_model():
    with pytest.raises(ValueError, match="transition"):
        target(hand_batch(), torch.zeros(3, 1), expansion=2)


# Losses, Adam and the soft update.


def test_losses_by_hand():
    observation, action = observe(torch.tensor([[0.0, 1.0], [0.0, -5.0]])), torch.ones(2, 1)
    goal = torch.tensor([12.0, 5.0])
    # Q1 = (12, 6), Q2 = (11.5, 11.5)
    expected = ((0**2 + 1**2) + (0.5**2 + 6.5**2)) / 2
    loss = critic_loss(FLAT_CRITICS, observation, action, goal, BOUNDS)
    assert loss.item() == pytest.approx(expected)
    a = math.tanh(0.5)
    expected = -((11 + 2 * a) + (5 + 2 * a)) / 2
    loss = actor_loss(FLAT_ACTOR, FLAT_CRITICS, observation, BOUNDS)
    assert loss.item() == pytest.approx(expected)


def test_saturated_actors_pay_and_come_back():
    observation = observe(torch.tensor([[0.0, 1.0], [0.0, -5.0]]))
    actor = [FLAT_ACTOR[0], torch.full_like(FLAT_ACTOR[1], 30.0)]
    free, slope = _loss_and_slope(actor, observation, 0.0)
    assert slope == 0.0, "the slope of tanh is none out there"
    priced, slope = _loss_and_slope(actor, observation, 0.1)
    # Q1 = (13, 7) at the bound.
    assert priced - free == pytest.approx(0.1 * 3.0 * 28.0**2)
    assert slope == pytest.approx(0.1 * 3.0 * 2 * 28.0)
    near = [FLAT_ACTOR[0], torch.full_like(FLAT_ACTOR[1], 1.9)]
    assert _loss_and_slope(near, observation, 0.1) == _loss_and_slope(near, observation, 0.0)


def test_restless_actors_pay_for_what_changes_from_a_state_to_the_next():
    observation = observe(torch.tensor([[0.0, 1.0], [0.0, -5.0]]))
    actor = [torch.tensor([[0.0, 0.0, 0.1]]), torch.zeros(1)]  # tanh(0.1 velocity)
    following = observe(torch.tensor([[0.0, 1.0], [0.0, 0.0]]))
    free = actor_loss(actor, FLAT_CRITICS, observation, BOUNDS)
    args = observation, BOUNDS, 0.0, 0.1
    still = actor_loss(actor, FLAT_CRITICS, *args, observation)
    assert still == free, "nothing changes"
    loss = actor_loss(actor, FLAT_CRITICS, *args, following)
    values = torch.tensor([11 + 2 * math.tanh(0.1), 5 + 2 * math.tanh(-0.5)])
    price = 0.1 * values.std(correction=0).item() * math.tanh(0.5) ** 2 / 2
    assert (loss - free).item() == pytest.approx(price, rel=1e-5)


def _loss_and_slope(actor, observation, price):
    weight, bias = actor
    bias = bias.clone().requires_grad_()
    loss = actor_loss([weight, bias], FLAT_CRITICS, observation, BOUNDS, price)
    loss.backward()
    return loss.item(), bias.grad.item()


@pytest.mark.parametrize("rate", [1e-1, 1e-3])
def test_adam_is_torchs(rate):
    params = [torch.randn(4, 3), torch.randn(4)]
    reference = [param.clone().requires_grad_() for param in params]
    optimizer = torch.optim.Adam(reference, lr=rate)
    means, squares = ([torch.zeros_like(param) for param in params] for _ in range(2))
    for step in range(1, 8):
        grads = [torch.randn_like(param) * 10.0 ** (step - 4) for param in params]
        for param, grad in zip(reference, grads, strict=True):
            param.grad = grad.clone()
        optimizer.step()
        adam_(params, grads, means, squares, *adam_rates(torch.tensor(step), rate))
        for param, expected in zip(params, reference, strict=True):
            torch.testing.assert_close(param, expected.detach(), rtol=1e-5, atol=1e-4 * rate)
    for param, mean, square in zip(reference, means, squares, strict=True):
        torch.testing.assert_close(mean, optimizer.state[param]["exp_avg"])
        torch.testing.assert_close(square, optimizer.state[param]["exp_avg_sq"])


def test_soft_update_by_hand():
    targets, sources = [torch.tensor([1.0, 2.0])], [torch.tensor([3.0, 2.0])]
    soft_update_(targets, sources, 0.25)
    assert targets[0].tolist() == [1.5, 2.0]
    assert sources[0].tolist() == [3.0, 2.0]
