"""Critics fitted to returns in the model: targets by hand, what is learned, and what stays."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from lopsided import LOPSIDED

from phihp_torchrl import get_task
from phihp_torchrl.agents import (
    CriticRefit,
    RefitConfig,
    TD3Config,
    TD3Update,
    act,
    make_td3_loss,
)
from phihp_torchrl.agents.equations import q_values
from phihp_torchrl.imagination import Rollouts
from phihp_torchrl.worlds import SimulatedWorld

GAMMA = 0.9
SMALL = RefitConfig(interval=1, transitions=256, horizon=7, steps=1, batch_size=64)


def make(task="pendulum", config=SMALL):
    model = SimulatedWorld(task).model()
    td3 = TD3Config(
        actor_hidden_sizes=(16,), critic_hidden_sizes=(32, 32), gamma=GAMMA, last_layer_scale=1.0
    )
    update = TD3Update(make_td3_loss(model, td3), model, td3)
    rollouts = Rollouts(model, act, model.task.max_steps)
    return CriticRefit(model, rollouts, config, GAMMA), update, model


def situations(model, count=256):
    state, bounds = model.task.coverage.sample([count]), model.task.bounds
    return state, bounds.from_unit(2 * torch.rand(count, len(bounds.low)) - 1)


def returns_by_hand(model, actor, state, action, steps):
    """Discounted rewards of episodes, and the states, weights and actions at their ends."""
    bounds = model.task.bounds
    total, weight = torch.zeros(len(state)), torch.ones(len(state))
    for _ in range(steps):
        state, reward, terminated = model.transition(state, action)
        total += weight * reward
        weight *= GAMMA * (1.0 - terminated.float())
        action = act(actor, model.observe(state), bounds)
    return total, weight, state, action


@pytest.mark.parametrize("task", ["pendulum", "cartpole", LOPSIDED])  # the second terminates
def test_targets_by_hand(task):
    refit, update, model = make(task)
    state, action = situations(model, 20)
    bounds = model.task.bounds
    value = q_values(update.critics, model.observe(state), action, bounds).mean(0)
    target, lag = refit._targets(update.actor, update.critics, state, action, value)
    steps = SMALL.horizon + 1
    total, weights, end, last = returns_by_hand(model, update.actor, state, action, steps)
    expected = total + weights * q_values(update.critics, model.observe(end), last, bounds).mean(0)
    assert task != "cartpole" or (weights == 0).any()
    constant = (expected - value).mean() / (1 - weights).mean()
    torch.testing.assert_close(lag, constant, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(target, expected + weights * constant, rtol=1e-3, atol=1e-3)
    # With its lag the value agrees with the targets on average, so the constant is settled.
    torch.testing.assert_close((value + lag).mean(), target.mean(), rtol=1e-3, atol=1e-3)


def test_values_come_to_what_the_actor_earns():
    refit, update, model = make(config=replace(SMALL, horizon=60, steps=600, transitions=2048))
    result = refit(update.actor, update.critics, *situations(model, 2048))
    bounds = model.task.bounds
    state, _ = situations(model, 200)
    action = act(update.actor, model.observe(state), bounds)
    truth = returns_by_hand(model, update.actor, state, action, 80)[0]
    before = q_values(update.critics, model.observe(state), action, bounds).mean(0)
    after = q_values(result.critics, model.observe(state), action, bounds).mean(0)
    assert (after - truth).square().mean() < 0.05 * (before - truth).square().mean()
    assert abs((after - truth).mean()) < 0.1 * truth.std()
    assert result.error_after < 0.5 * result.error_before


def test_first_actions_are_given_or_near_the_actors():
    refit, update, model = make(LOPSIDED)
    state, _ = situations(model, 4000)
    own = act(update.actor, model.observe(state), LOPSIDED.bounds)
    given = torch.full_like(own, -5.5)
    mixed = refit._mix(own, given, torch.Generator().manual_seed(0))
    near = (mixed != given).flatten()
    assert near.float().mean().item() == pytest.approx(0.5, abs=0.05)
    # A tenth of the half-range of 9, but for what the bounds cut off.
    assert (mixed - own)[near].std().item() == pytest.approx(0.9, rel=0.1)
    assert (mixed >= -6).all()
    assert (mixed <= 12).all()


def test_the_given_networks_stay_as_they_are():
    refit, update, model = make()
    before = [layer.clone() for layer in (*update.actor, *update.critics)]
    result = refit(update.actor, update.critics, *situations(model))
    for layer, old in zip((*update.actor, *update.critics), before, strict=True):
        assert torch.equal(layer, old)
    assert not torch.equal(result.critics[0], update.critics[0])


def test_reproducible():
    refit, update, model = make()
    state, action = situations(model)
    first, second = (
        refit(update.actor, update.critics, state, action, torch.Generator().manual_seed(seed))
        for seed in (3, 3)
    )
    assert first.lag == second.lag
    assert all(map(torch.equal, first.critics, second.critics))


def test_returns_that_are_not_finite_teach_nothing():
    task = get_task("pendulum")

    def reward(state, action, next_state):
        good = task.reward(state, action, next_state)
        return torch.where(state[..., 1] > 0, torch.full_like(good, torch.nan), good)

    refit, update, model = make(replace(task, reward=reward))
    result = refit(update.actor, update.critics, *situations(model))
    assert all(layer.isfinite().all() for layer in result.critics)


@pytest.mark.usefixtures("traced")  # its gradient is that of test_td3, which is compiled there
def test_compiled_equals_eager():
    short = replace(SMALL, horizon=2)
    refit, update, model = make(config=short)
    compiled = CriticRefit(model, refit.rollouts, short, GAMMA, compile=True)
    state, action = situations(model)
    results = [
        fit(update.actor, update.critics, state, action, torch.Generator().manual_seed(0)).critics
        for fit in (refit, compiled)
    ]
    for eager, fast in zip(*results, strict=True):
        torch.testing.assert_close(eager, fast, rtol=1e-4, atol=1e-5)


def test_restart_sets_networks_and_targets():
    _, update, _ = make()
    actor, critics = (
        [torch.rand_like(p) for p in group] for group in (update.actor, update.critics)
    )
    update.restart(actor, critics)
    nets = update.networks
    for mine, given in zip((*nets.actor, *nets.critics), (*actor, *critics), strict=True):
        assert torch.equal(mine, given)
    for mine, given in zip(
        (*nets.target_actor, *nets.target_critics), (*actor, *critics), strict=True
    ):
        assert torch.equal(mine, given)


def test_when():
    config = RefitConfig(start=4, interval=2)
    assert [n for n in range(11) if config.is_due(n, total=9)] == [4, 6, 8, 9, 10]
    at_the_end = RefitConfig(start=0, interval=2)
    assert [n for n in range(11) if at_the_end.is_due(n, total=9)] == [9, 10]
    assert not any(RefitConfig(interval=0).is_due(n, total=9) for n in range(11))
    assert [n for n in range(0, 9500, 500) if RefitConfig().is_due(n, total=9000)] == [9000]
    counts = [of.fits(total=9) for of in (config, at_the_end, RefitConfig(interval=0))]
    assert counts == [3.5, 1.0, 0.0]


@pytest.mark.parametrize(
    ("name", "value"),
    [("transitions", 0), ("horizon", 0), ("steps", -1), ("start", -1), ("interval", -2)],
)
def test_config_errors_name_the_key(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        RefitConfig(**{name: value})
