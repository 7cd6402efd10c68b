"""TD3 as one fused step: equal to stock TorchRL, resumable, compiled, and learning."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
from lopsided import LOPSIDED
from stock_td3 import StockTD3Update

from phihp_torchrl import get_task
from phihp_torchrl.agents import TD3Config, TD3Update, act, learning_rate_scale, make_td3_loss
from phihp_torchrl.imagination import Batch
from phihp_torchrl.tasks import Box, Task

from .td3_parts import SMALL, copies, make_batch, make_model, make_update, rows, same

# Stock TorchRL.


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize("task", ["pendulum", "cartpole", "acrobot-swingup", LOPSIDED])
def test_equals_stock_torchrl(task, delay):
    config = replace(SMALL, target_noise=0.0, policy_delay=delay, tau=0.05, gamma=0.9)
    fused = make_update(config, task)
    stock = StockTD3Update(copy.deepcopy(fused.loss), fused.world_model, config)
    for _ in range(4):
        batch = make_batch(fused.world_model, 8 * delay)
        expected = stock(batch)
        for key, value in fused(batch).items():
            torch.testing.assert_close(value, expected[key], rtol=1e-4, atol=1e-5)
    ours, theirs = fused.loss.state_dict(), stock.loss.state_dict()
    assert ours.keys() == theirs.keys()
    for key, value in ours.items():
        torch.testing.assert_close(value, theirs[key], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("task", ["pendulum", LOPSIDED])
def test_equals_stock_torchrl_under_the_same_noise(task, monkeypatch):
    config = replace(SMALL, target_noise=0.4, target_noise_clip=0.5, policy_delay=1)
    fused = make_update(config, task)
    stock = StockTD3Update(copy.deepcopy(fused.loss), fused.world_model, config)
    batch = make_batch(fused.world_model, 64)
    noise = torch.randn(64, 1)
    monkeypatch.setattr(torch, "randn", lambda *_, **__: noise)
    monkeypatch.setattr(torch, "randn_like", lambda *_, **__: noise)
    losses = fused(batch)
    expected = stock(batch)
    torch.testing.assert_close(losses["loss_qvalue"], expected["loss_qvalue"])
    torch.testing.assert_close(losses["loss_actor"], expected["loss_actor"])


def test_stock_torchrl_knows_no_value_expansion():
    update = make_update()
    with pytest.raises(ValueError, match="value_expansion: expected 1, got 2"):
        StockTD3Update(update.loss, update.world_model, replace(SMALL, value_expansion=2))


# Bounds.


def test_bounds_are_only_a_unit_of_measure():
    """The same transitions in units of the half-range teach the same within any bounds."""
    config = replace(SMALL, target_noise=0.4, target_noise_clip=0.5)
    symmetric, lopsided = make_update(config), make_update(config, LOPSIDED)
    weights = {
        key: value.clone()
        for key, value in symmetric.state_dict().items()
        if not key.endswith(("min_action", "max_action"))  # the bounds
    }
    lopsided.load_state_dict(weights, strict=False)
    here, there = (update.world_model.task.bounds for update in (symmetric, lopsided))
    for seed in range(3):
        batch = make_batch(symmetric.world_model, 32)
        moved = batch._replace(action=there.from_unit(here.to_unit(batch.action)))
        losses, others = (
            update(data, generator=torch.Generator().manual_seed(seed))
            for update, data in ((symmetric, batch), (lopsided, moved))
        )
        torch.testing.assert_close(losses, others, rtol=1e-4, atol=1e-5)
    for one, other in zip(symmetric.actor, lopsided.actor, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)
    for one, other in zip(symmetric.critics, lopsided.critics, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_target_noise_is_clipped(monkeypatch):
    seen = []
    update = make_update(replace(SMALL, target_noise=0.2, target_noise_clip=0.5), LOPSIDED)
    step = update._compiled_step

    def watched(batch, noise, *rest):
        seen.append(noise)
        return step(batch, noise, *rest)

    update._compiled_step = watched
    update(make_batch(update.world_model, 4000), generator=torch.Generator().manual_seed(0))
    noise = seen[0] / LOPSIDED.bounds.scale
    assert noise.shape == (4000, 1)
    assert noise.abs().max().item() == pytest.approx(0.5)
    assert noise.std().item() == pytest.approx(0.2, rel=0.1)
    assert (noise.abs() == 0.5).float().mean() < 0.05


# Parts of a step.


def test_actor_and_critics_learn_apart():
    # Where a rate is hardly above nothing, whatever moves was moved by the other's gradient.
    for frozen, moving in (("actor", "critics"), ("critics", "actor")):
        rates = {f"{frozen.removesuffix('s')}_learning_rate": 1e-30}
        update = make_update(replace(SMALL, **rates))
        before = copies(update)
        update(make_batch(update.world_model, 16))
        after = copies(update)
        assert same(before[frozen], after[frozen])
        assert not same(before[moving], after[moving])


def test_targets_follow_at_their_rate():
    update = make_update(replace(SMALL, tau=0.25))
    before = copies(update)
    update(make_batch(update.world_model, 16))
    after = copies(update)
    for name in ("actor", "critics"):
        targets = before[f"target_{name}"], after[f"target_{name}"]
        for old, new, source in zip(*targets, after[name], strict=True):
            torch.testing.assert_close(new, 0.75 * old + 0.25 * source)


def test_learning_rates_scale():
    update = make_update()
    before = copies(update)
    update(make_batch(update.world_model, 16), learning_rate_scale=0.0)
    after = copies(update)
    assert same(before["actor"], after["actor"])
    assert same(before["critics"], after["critics"])


def test_parameters_are_those_of_the_loss():
    update = make_update()
    stock = StockTD3Update(update.loss, update.world_model, SMALL)
    data = stock.as_tensordict(make_batch(update.world_model, 8))
    before = update.loss(data)["loss_actor"].item()
    update(make_batch(update.world_model, 16))
    assert update.loss(data)["loss_actor"].item() != before


def test_resumes_to_the_bit():
    one = make_update()
    batches = [make_batch(one.world_model, 16) for _ in range(4)]
    for batch in batches[:2]:
        one(batch, generator=torch.Generator().manual_seed(0))
    other = make_update()
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    for batch in batches[2:]:
        one(batch, generator=torch.Generator().manual_seed(0))
        other(batch, generator=torch.Generator().manual_seed(0))
    for key, value in one.state_dict().items():
        assert torch.equal(other.state_dict()[key], value), key


def test_generator_alone_is_drawn_from():
    update = make_update()
    batch = make_batch(update.world_model, 16)
    before = torch.get_rng_state()
    update(batch, generator=torch.Generator().manual_seed(0))
    assert torch.equal(before, torch.get_rng_state())


def test_a_step_is_one_graph():
    """With a value expansion; without one it is compiled to machine code below."""
    update = make_update(replace(SMALL, value_expansion=2, target_noise=0.0))
    compiled = copy.deepcopy(update)
    compiled._compiled_step = torch.compile(compiled._step, fullgraph=True, backend="eager")
    for _ in range(2):
        batch = make_batch(update.world_model, 16)
        losses = compiled(batch)
        for key, value in update(batch).items():
            torch.testing.assert_close(losses[key], value)
    for one, other in zip(
        update.state_dict().values(), compiled.state_dict().values(), strict=True
    ):
        torch.testing.assert_close(one, other)


@pytest.mark.slow
def test_compiled_by_inductor_equals_eager():
    # Wide enough for oneDNN, which sums in another order.
    wide = replace(SMALL, actor_hidden_sizes=(96,), critic_hidden_sizes=(96,))
    update = make_update(wide, compile=True)
    eager = make_update(wide)
    eager.load_state_dict(copy.deepcopy(update.state_dict()))
    with torch._dynamo.config.patch(error_on_recompile=True):
        for seed in range(3):
            batch = make_batch(update.world_model, 256)
            losses = update(batch, generator=torch.Generator().manual_seed(seed))
            expected = eager(batch, generator=torch.Generator().manual_seed(seed))
            torch.testing.assert_close(losses, expected, rtol=1e-4, atol=1e-5)
    for one, other in zip(update.state_dict().values(), eager.state_dict().values(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)


def test_a_copy_trains_apart():
    update = make_update()
    batch = make_batch(update.world_model, 16)
    update(batch)
    copied = copy.deepcopy(update)
    before = copies(update)
    copied(batch)
    assert same(before["actor"], copies(update)["actor"])
    assert not same(before["actor"], copies(copied)["actor"])
    update.double()
    assert update.networks.actor[0].dtype == torch.float64, "looked up anew"


@pytest.mark.parametrize(
    ("decay", "left", "scale"),
    [
        (0.0, 0.0, 1.0),
        (0.5, 1.0, 1.0),
        (0.5, 0.5, 1.0),
        (0.5, 0.25, 0.5),
        (0.5, 0.0, 0.05),
    ],
)
def test_learning_rates_fall_at_the_end(decay, left, scale):
    assert learning_rate_scale(left, decay) == scale


# Learning.


def flat_task() -> Task:
    """One step, after which it is over; the best action is the sign of the state."""
    base = get_task("pendulum")

    def reward(state, action, next_state):
        return -(action[..., 0] - torch.where(state[..., 1] > 0, 1.0, -1.0)).square()

    return replace(
        base,
        name="flat",
        reset=Box.around((0.0, 0.0), (3.0, 1.0)),
        reward=reward,
        terminated=lambda next_state: torch.ones_like(next_state[..., 0], dtype=torch.bool),
    )


def test_learns_a_task_of_one_step():
    task = flat_task()
    model = make_model(task)
    config = replace(SMALL, critic_learning_rate=5e-3, actor_learning_rate=5e-3)
    update = TD3Update(make_td3_loss(model, config), model, config)
    generator = torch.Generator().manual_seed(0)

    def score():
        state = task.reset.sample([500], generator=torch.Generator().manual_seed(1))
        action = act(update.actor, model.observe(state), task.bounds)
        return model.transition(state, action)[1].mean().item()

    before = score()
    losses = []
    for _ in range(150):
        state = task.reset.sample([128], generator=generator)
        action = 4 * torch.rand(128, 1, generator=generator) - 2
        next_state, reward, terminated = model.transition(state, action)
        batch = Batch(state, action, reward, next_state, terminated)
        losses.append(update(batch, generator=generator)["loss_qvalue"].item())
    assert sum(losses[-20:]) < 0.3 * sum(losses[:20])
    # Zero torque always earns -1, and so does at best whoever does not look at the state.
    assert before < -0.7
    assert score() > -0.5


# Errors.


def test_rows_divide_by_the_delay():
    update = make_update()
    batch = make_batch(update.world_model, 3)
    for wrong in (batch, rows(batch, 0, 0)):
        with pytest.raises(ValueError, match="policy_delay"):
            update(wrong)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("actor_learning_rate", 0.0),
        ("critic_learning_rate", math.nan),
        ("policy_delay", 0),
        ("value_expansion", 0),
        ("gamma", 0.0),
        ("gamma", 1.1),
        ("tau", 0.0),
        ("tau", 2.0),
        ("target_noise", -0.1),
        ("target_noise_clip", -0.1),
        ("last_layer_scale", -1.0),
    ],
)
def test_config_errors_name_the_key(name, value):
    with pytest.raises(ValueError, match=f"^{name}:"):
        TD3Config(**{name: value})
