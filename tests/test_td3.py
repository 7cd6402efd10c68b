"""TD3 as one fused step: equal to stock TorchRL, to torch's Adam, and to sums by hand."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives.value import TD0Estimator

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import Batch, StockTD3Update, TD3Config, TD3Update, make_td3_loss
from phihp_torchrl.agents.functional import (
    actor_loss,
    adam_,
    adam_rates,
    critic_loss,
    policy,
    q_values,
    soft_update_,
    td3_target,
)
from phihp_torchrl.agents.td3 import layers
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.tasks import Box, Task

SMALL = TD3Config(
    actor_hidden_sizes=(16, 16), critic_hidden_sizes=(16, 16, 16), critic_learning_rate=1e-3
)


def make_model(name="pendulum"):
    task = get_task(name)
    return TaskWorldModel(task, HybridDynamics.oracle(task))


def make_update(config=SMALL, name="pendulum", **options):
    model = make_model(name)
    return TD3Update(make_td3_loss(model, config), model, config, **options)


def make_batch(model, count):
    task = model.task
    state = (task.coverage or task.reset).sample([count])
    action = torch.tensor(task.action_high) * (2 * torch.rand(count, task.system.action_dim) - 1)
    next_state, reward, terminated = model.transition(state, action)
    terminated = terminated | (torch.rand(count) < 0.2)
    return Batch(state, action, reward, next_state, terminated)


def rows(batch, start, stop):
    return Batch(*(column[start:stop] for column in batch))


def copies(update):
    groups = {
        "actor": update.actor,
        "critics": update.critics,
        "target_actor": layers(update.loss.target_actor_network_params),
        "target_critics": layers(update.loss.target_qvalue_network_params),
    }
    return {name: [layer.clone() for layer in group] for name, group in groups.items()}


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


# Stock TorchRL


@pytest.mark.parametrize("delay", [1, 2, 3])
@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot-swingup"])
def test_equals_stock_torchrl(name, delay):
    config = replace(SMALL, target_noise=0.0, policy_delay=delay, tau=0.05, gamma=0.9)
    fused = make_update(config, name)
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


def test_equals_stock_torchrl_under_the_same_noise(monkeypatch):
    config = replace(SMALL, target_noise=0.4, target_noise_clip=0.5, policy_delay=1)
    fused = make_update(config)
    stock = StockTD3Update(copy.deepcopy(fused.loss), fused.world_model, config)
    batch = make_batch(fused.world_model, 64)
    noise = torch.randn(64, 1)
    monkeypatch.setattr(torch, "randn", lambda *_, **__: noise)
    monkeypatch.setattr(torch, "randn_like", lambda *_, **__: noise)
    losses = fused(batch)
    expected = stock(batch)
    torch.testing.assert_close(losses["loss_qvalue"], expected["loss_qvalue"])
    torch.testing.assert_close(losses["loss_actor"], expected["loss_actor"])


def test_functional_networks_are_the_modules():
    loss = make_td3_loss(make_model("cartpole"), SMALL)
    update = TD3Update(loss, make_model("cartpole"), SMALL)
    observation, action = torch.randn(7, 5), torch.randn(7, 1)
    with loss.actor_network_params.to_module(loss.actor_network):
        expected = loss.actor_network(TensorDict(observation=observation))["action"]
    torch.testing.assert_close(policy(update.actor, observation, loss.max_action), expected)
    values = q_values(update.critics, observation, action, loss.max_action)
    assert values.shape == (2, 7)
    for i in range(2):
        with loss.qvalue_network_params[i].to_module(loss.qvalue_network):
            data = TensorDict(observation=observation, action=action)
            expected = loss.qvalue_network(data)["state_action_value"][:, 0]
        torch.testing.assert_close(values[i], expected)


# Targets by hand

HIGH = torch.tensor([2.0])
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
    return get_task("pendulum").system.observe(state)


def target(batch, noise, **options):
    options = {"gamma": 0.9, "observe": observe, **options}
    return td3_target(batch, FLAT_ACTOR, FLAT_CRITICS, noise, HIGH, **options)


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


def test_target_noise_is_clipped(monkeypatch):
    seen = []
    update = make_update(replace(SMALL, target_noise=0.2, target_noise_clip=0.5))
    step = update._compiled_step

    def watched(batch, noise, *rest):
        seen.append(noise)
        return step(batch, noise, *rest)

    update._compiled_step = watched
    update(make_batch(update.world_model, 4000), generator=torch.Generator().manual_seed(0))
    noise = seen[0] / update.loss.max_action
    assert noise.shape == (4000, 1)
    assert noise.abs().max().item() == pytest.approx(0.5)
    assert noise.std().item() == pytest.approx(0.2, rel=0.1)
    assert (noise.abs() == 0.5).float().mean() < 0.05


@pytest.mark.parametrize("name", ["pendulum", "cartpole"])
def test_expansion_is_the_explicit_sum(name):
    update = make_update(SMALL, name)
    model, high, gamma, steps = update.world_model, update.loss.max_action, 0.9, 3
    batch = make_batch(model, 32)
    batch = batch._replace(next_state=model.task.reset.sample([32]) * 3)  # some will fall
    noise = 0.1 * torch.randn(32, high.shape[0])
    actor, critics = update.actor, update.critics
    values = td3_target(
        batch, actor, critics, noise, high, gamma, model.observe, model.transition, steps
    )
    for i in range(32):
        expected, discount = batch.reward[i].item(), gamma
        state, alive = batch.next_state[i : i + 1], not batch.terminated[i]
        for _ in range(steps - 1):
            if alive:
                action = policy(actor, model.observe(state), high)
                state, reward, terminated = model.transition(state, action)
                expected += discount * reward.item()
                discount *= gamma
                alive = not terminated.item()
        if alive:
            observation = model.observe(state)
            action = (policy(actor, observation, high) + noise[i]).clamp(-high, high)
            expected += discount * q_values(critics, observation, action, high).min().item()
        assert values[i].item() == pytest.approx(expected, rel=1e-4, abs=1e-4)
    fewer = td3_target(batch, actor, critics, noise, high, gamma, model.observe)
    assert not torch.allclose(values, fewer)


def test_expansion_is_torchrls_return_of_several_steps():
    update = make_update()
    model, high, gamma, k = update.world_model, update.loss.max_action, 0.9, 3
    batch = make_batch(model, 16)._replace(terminated=torch.zeros(16, dtype=torch.bool))
    total, state = batch.reward.clone(), batch.next_state
    for i in range(1, k):
        action = policy(update.actor, model.observe(state), high)
        state, reward, _ = model.transition(state, action)
        total += gamma**i * reward
    observation = model.observe(state)
    action = policy(update.actor, observation, high)
    # What TorchRL's MultiStep transform would have made of k real steps.
    ended = torch.zeros(16, 1, dtype=torch.bool)
    following = TensorDict(
        reward=total.unsqueeze(-1), done=ended, terminated=ended, batch_size=[16]
    )
    steps = torch.full((16, 1), k)
    data = TensorDict(next=following, steps_to_next_obs=steps, batch_size=[16])
    expected = TD0Estimator(gamma=gamma, value_network=None).value_estimate(
        data, next_value=q_values(update.critics, observation, action, high).amin(0).unsqueeze(-1)
    )
    values = td3_target(
        batch, update.actor, update.critics, torch.zeros(16, 1), high, gamma,
        model.observe, model.transition, k,
    )  # fmt: skip
    torch.testing.assert_close(values, expected.squeeze(-1))


def test_expansion_needs_a_model():
    with pytest.raises(ValueError, match="transition"):
        target(hand_batch(), torch.zeros(3, 1), expansion=2)


def test_losses_by_hand():
    observation, action = observe(torch.tensor([[0.0, 1.0], [0.0, -5.0]])), torch.ones(2, 1)
    goal = torch.tensor([12.0, 5.0])
    # Q1 = (12, 6), Q2 = (11.5, 11.5)
    expected = ((0**2 + 1**2) + (0.5**2 + 6.5**2)) / 2
    loss = critic_loss(FLAT_CRITICS, observation, action, goal, HIGH)
    assert loss.item() == pytest.approx(expected)
    a = math.tanh(0.5)
    expected = -((11 + 2 * a) + (5 + 2 * a)) / 2
    loss = actor_loss(FLAT_ACTOR, FLAT_CRITICS, observation, HIGH)
    assert loss.item() == pytest.approx(expected)


# Parts of a step


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


@pytest.mark.parametrize("expansion", [1, 3])
def test_a_step_is_one_graph(expansion):
    update = make_update(replace(SMALL, value_expansion=expansion, target_noise=0.0))
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
    wide = replace(SMALL, actor_hidden_sizes=(96, 96), critic_hidden_sizes=(96, 96))
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


# Learning


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
    model = TaskWorldModel(task, HybridDynamics.oracle(task))
    config = replace(SMALL, critic_learning_rate=3e-3, actor_learning_rate=3e-3)
    update = TD3Update(make_td3_loss(model, config), model, config)
    generator = torch.Generator().manual_seed(0)

    def score():
        state = task.reset.sample([500], generator=torch.Generator().manual_seed(1))
        action = policy(update.actor, model.observe(state), update.loss.max_action)
        return model.transition(state, action)[1].mean().item()

    before = score()
    losses = []
    for _ in range(300):
        state = task.reset.sample([128], generator=generator)
        action = 4 * torch.rand(128, 1, generator=generator) - 2
        next_state, reward, terminated = model.transition(state, action)
        batch = Batch(state, action, reward, next_state, terminated)
        losses.append(update(batch, generator=generator)["loss_qvalue"].item())
    assert sum(losses[-20:]) < 0.3 * sum(losses[:20])
    # Zero torque always earns -1, and so does at best whoever does not look at the state.
    assert before < -0.7
    assert score() > -0.5


# Errors


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
