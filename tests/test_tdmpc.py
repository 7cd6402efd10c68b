"""TD-MPC's networks, losses and replay, by hand and by property."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import get_task
from phihp_torchrl.agents.tdmpc import (
    TOLD,
    EpisodeReplay,
    Slices,
    TDMPCConfig,
    TDMPCLoss,
    TDMPCLossConfig,
    TDMPCUpdate,
    TensorPrioritizedSliceSampler,
    TOLDConfig,
)
from phihp_torchrl.agents.tdmpc.losses import (
    model_losses,
    policy_loss,
    td_target,
    temporal_weights,
)

torch.set_num_threads(1)
SMALL = TOLDConfig(latent_dim=6, encoder_dim=8, mlp_dim=16)
NETWORKS = ("encoder", "dynamics", "reward", "critics", "actor", "termination")


def make_told(seed=0, terminates=True):
    """Small networks without the zeros of the last layers, which would hide gradients."""
    torch.manual_seed(seed)
    told = TOLD(3, [2.0], SMALL, terminates=terminates)
    for network in (told.reward, *told.critics):
        torch.nn.init.orthogonal_(network[-1].weight)
    return told


def make_slices(count=4, horizon=3, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(count, horizon, *shape, generator=generator)

    return TensorDict(
        observation=normal(3),
        action=normal(1),
        valid=torch.ones(count, horizon, dtype=torch.bool),
        next=TensorDict(
            observation=normal(3),
            reward=normal(1),
            terminated=torch.zeros(count, horizon, 1, dtype=torch.bool),
            batch_size=[count, horizon],
        ),
        batch_size=[count, horizon],
    )


# Networks.


def test_the_publications_sizes_and_initialisation():
    told = TOLD.for_task(get_task("cartpole"))
    widths = [tuple(p.shape) for p in told.dynamics.parameters() if p.ndim == 2]
    assert widths == [(512, 51), (512, 512), (50, 512)]
    assert [tuple(p.shape) for p in told.encoder.parameters() if p.ndim == 2] == [
        (256, 5),
        (50, 256),
    ]
    assert len(told.critics) == 2
    torch.testing.assert_close(told.dynamics[2].weight @ told.dynamics[2].weight.T, torch.eye(512))
    for network in (told.reward, *told.critics):
        assert not network[-1].weight.any()
    assert told.actor[-1].weight.any()
    linear = [m for m in told.modules() if isinstance(m, torch.nn.Linear)]
    assert not any(m.bias.any() for m in linear)
    assert told.termination is not None
    assert TOLD.for_task(get_task("pendulum")).termination is None


def test_twin_critics_differ_and_actions_are_in_physical_units():
    told = make_told()
    latent, action = torch.randn(5, 6), torch.randn(5, 1)
    values = told.q_values(latent, action)
    assert not torch.equal(values[0], values[1])
    assert torch.equal(told.twin_values(latent, action), values.T)
    noisy = told.policy(latent, torch.full((5, 1), 100.0))
    assert noisy.tolist() == [[2.0]] * 5
    half = TOLD(3, [1.0], SMALL, terminates=True)
    half.load_state_dict({**told.state_dict(), "action_high": torch.tensor([1.0])})
    torch.testing.assert_close(half.q_values(latent, action / 2), values)


def test_gradients_pass_the_clipping_of_noise():
    """At 0.76 of the bounds noise of 0.9 is clipped; the gradient is that of tanh all the same."""
    output = torch.tensor([[1.0]], requires_grad=True)
    action = make_told().squash(output, torch.tensor([[0.9]]))
    action.sum().backward()
    assert action.item() == pytest.approx(2.0)
    assert output.grad.item() == pytest.approx(2.0 / torch.cosh(torch.tensor(1.0)).item() ** 2)


@pytest.mark.parametrize("name", ["latent_dim", "encoder_dim", "mlp_dim"])
def test_bad_sizes_are_named(name):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        TOLDConfig(**{name: 0})


# Equations.


class LinearTOLD:
    """Latents are observations of one number; everything else is linear, for sums by hand."""

    def __init__(self, shift=0.0):
        self.shift = shift

    def encode(self, observation):
        return observation + self.shift

    def actor(self, latent):
        return 0.5 * latent

    def squash(self, output, noise=None):
        return output + (0.0 if noise is None else noise)

    def policy(self, latent, noise=None):
        return self.squash(self.actor(latent), noise)

    def predict(self, latent, action):
        return latent + action, (2 * latent).squeeze(-1)

    def q_values(self, latent, action, held=False):
        return torch.stack([latent + action + self.shift, 3 * latent]).squeeze(-1)

    def termination_logit(self, latent):
        return None


def hand_slices(terminated=(False, False), valid=(True, True)):
    """Observations 1, 2, 4; actions 1, 2; rewards 10, 20."""
    return Slices(
        observation=torch.tensor([[[1.0], [2.0]]]),
        action=torch.tensor([[[1.0], [2.0]]]),
        reward=torch.tensor([[10.0, 20.0]]),
        next_observation=torch.tensor([[[2.0], [4.0]]]),
        terminated=torch.tensor([terminated]),
        valid=torch.tensor([valid]),
    )


def test_targets_by_hand():
    """In 2 and 4 the policy does 1 and 2, the targets say 3 and 6 plus 1 (6 and 12: too much)."""
    noise = torch.zeros(1, 2, 1)
    target = SimpleNamespace(q_values=LinearTOLD(1.0).q_values)
    y = td_target(LinearTOLD(), target, hand_slices(), noise, gamma=0.5)
    assert y.tolist() == [[10 + 0.5 * 4, 20 + 0.5 * 7]]
    y = td_target(LinearTOLD(), target, hand_slices((False, True)), noise, gamma=0.5)
    assert y.tolist() == [[10 + 0.5 * 4, 20.0]]
    y = td_target(LinearTOLD(), target, hand_slices(), noise + 0.25, gamma=0.5)
    assert y.tolist() == [[10 + 0.5 * 4.25, 20 + 0.5 * 7.25]]


def test_model_losses_by_hand():
    """Latents 1, 2, 4, target latents 3, 5; rewards 2, 4; values 2, 3 and 4, 6."""
    target = LinearTOLD(1.0)
    y = torch.tensor([[3.0, 5.0]])
    losses, latents = model_losses(LinearTOLD(), target, hand_slices(), y, rho=0.5)
    assert latents.flatten().tolist() == [1.0, 2.0, 4.0]
    assert losses.consistency.item() == 1 + 0.5 * 1
    assert losses.reward.item() == 64 + 0.5 * 256
    assert losses.value.item() == (1 + 0) + 0.5 * (1 + 1)
    assert losses.td_error.item() == (1 + 0) + 0.5 * (1 + 1)
    assert losses.termination.item() == 0.0
    short = hand_slices((True, False), (True, False))
    losses, _ = model_losses(LinearTOLD(), target, short, y, rho=0.5)
    assert [x.item() for x in losses] == [1.0, 64.0, 1.0, 0.0, 1.0]


def test_policy_loss_by_hand():
    """In 1, 2, 4 the critics say 1.5, 3 and 6 of the policy's action, and 3, 6, 12."""
    latents = torch.tensor([[[1.0], [2.0], [4.0]]])
    noise = torch.zeros(1, 3, 1)

    def loss(*args, **kwargs):
        return policy_loss(LinearTOLD(), latents, hand_slices(*args), noise, 0.5, **kwargs).item()

    assert loss() == -(1.5 + 0.5 * 3 + 0.25 * 6)
    assert loss((False, True)) == -(1.5 + 0.5 * 3)  # the last latent is beyond the end
    assert loss((True, False), (True, False)) == -1.5
    penalty = 0.5**2 + 0.5 * 1**2 + 0.25 * 2**2
    assert loss(output_penalty=0.5) == loss() + 0.5 * penalty


def test_termination_loss_is_the_cross_entropy_along_the_slice():
    told, slices = make_told(), make_slices(1, 2)
    slices["next", "terminated"][0, 1] = True
    typed = Slices(
        slices["observation"],
        slices["action"],
        slices["next", "reward"][..., 0],
        slices["next", "observation"],
        slices["next", "terminated"][..., 0],
        slices["valid"],
    )
    losses, latents = model_losses(told, told, typed, torch.zeros(1, 2), rho=0.5)
    p = told.termination_logit(latents[0, 1:]).sigmoid()
    expected = -(1 - p[0]).log() - 0.5 * p[1].log()
    torch.testing.assert_close(losses.termination[0], expected)


def test_temporal_weights():
    valid = torch.tensor([[True, True, True], [True, False, False]])
    assert temporal_weights(valid, 0.5).tolist() == [[1.0, 0.5, 0.25], [1.0, 0.0, 0.0]]


# The loss module.


def gradients(loss, told):
    told.zero_grad()
    loss.backward()
    return {
        name
        for name in NETWORKS
        if any(p.grad is not None and p.grad.any() for p in getattr(told, name).parameters())
    }


def test_gradients_reach_what_they_must_and_nothing_else():
    told, slices = make_told(), make_slices()
    slices["next", "terminated"][0, 2] = True
    loss = TDMPCLoss(told, TDMPCLossConfig())
    generator = torch.Generator().manual_seed(0)
    losses = loss(slices, generator)
    assert gradients(losses["loss_policy"], told) == {"actor"}
    losses = loss(slices, generator)
    assert gradients(losses["loss_model"], told) == set(NETWORKS) - {"actor"}
    assert all(p.grad is None and not p.requires_grad for p in loss.target.parameters())
    assert not any(losses[k].requires_grad for k in ("td_error", "loss_value", "loss_reward"))


@pytest.mark.parametrize("only", ["consistency", "reward", "value", "termination"])
def test_each_loss_trains_its_own_networks(only):
    """The value's target is fixed: with the value loss alone neither dynamics nor encoder of the
    next observation matter beyond the unrolled latent, and the policy gets nothing."""
    names = ("consistency", "reward", "value", "termination")
    config = TDMPCLossConfig(**{f"{name}_coef": float(name == only) for name in names})
    told = make_told()
    found = gradients(TDMPCLoss(told, config)(make_slices())["loss_model"], told)
    head = {"reward": "reward", "value": "critics", "termination": "termination"}.get(only)
    assert found == {"encoder", "dynamics", *([head] if head else [])}


def test_padding_counts_nowhere():
    told, slices = make_told(), make_slices()
    slices["valid"][:, 2] = False
    slices["next", "terminated"][:, 1] = True
    loss = TDMPCLoss(told, TDMPCLossConfig())
    results = []
    for value in (0.0, 7.0):
        for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
            slices[key][:, 2] = value
        told.zero_grad()
        losses = loss(slices, torch.Generator().manual_seed(0))
        (losses["loss_model"] + losses["loss_policy"]).backward()
        results.append([losses["td_error"], *(p.grad.clone() for p in told.parameters())])
    for one, other in zip(*results, strict=True):
        assert torch.equal(one, other)


def test_importance_weights_weigh_slices():
    told, slices = make_told(), make_slices()
    loss = TDMPCLoss(told, TDMPCLossConfig(policy_noise=0.0))
    each = [loss(slices[i : i + 1])["loss_model"] for i in range(4)]
    weight = torch.tensor([1.0, 0.5, 0.25, 0.0])
    slices["priority_weight"] = weight[:, None].expand(4, 3)
    torch.testing.assert_close(loss(slices)["loss_model"], (weight * torch.stack(each)).mean())


def test_keys_can_be_set():
    slices = make_slices().rename_key_("action", "torque")
    loss = TDMPCLoss(make_told(), TDMPCLossConfig())
    loss.set_keys(action="torque")
    assert "torque" in loss.in_keys
    assert loss(slices)["loss_model"].isfinite()


@pytest.mark.slow
def test_compiled_and_eager_losses_agree():
    results = []
    for compile in (False, True):
        told = make_told()
        losses = TDMPCLoss(told, TDMPCLossConfig(), compile=compile)(
            make_slices(), torch.Generator().manual_seed(0)
        )
        (losses["loss_model"] + losses["loss_policy"]).backward()
        results.append([losses["td_error"], *(p.grad for p in told.parameters())])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)


# The update.


def test_targets_follow_every_other_update():
    update = TDMPCUpdate(make_told(), TDMPCConfig(tau=0.25, target_interval=2))

    def parameters(told):
        return [
            p.detach().clone() for net in (told.encoder, told.critics) for p in net.parameters()
        ]

    start = parameters(update.loss.target)
    update(make_slices())
    assert all(map(torch.equal, start, parameters(update.loss.target)))
    update(make_slices(seed=1))
    now = parameters(update.loss.told)
    for old, target, new in zip(start, parameters(update.loss.target), now, strict=True):
        torch.testing.assert_close(target, 0.75 * old + 0.25 * new)


@pytest.mark.parametrize("scale", [1.0, 0.05])
def test_rates_and_their_scale(scale):
    """Adam's first step is the rate, whatever the gradient."""
    config = TDMPCConfig(learning_rate=1e-2, critic_learning_rate=1e-4)
    told = make_told()
    before = {name: p.clone() for name, p in told.named_parameters()}
    TDMPCUpdate(told, config)(make_slices(), scale)
    for name, p in told.named_parameters():
        step = (p - before[name]).abs().max().item()
        rate = 1e-4 if name.startswith("critics") else 1e-2
        assert step == pytest.approx(scale * rate, rel=0.02), name


def test_gradients_are_clipped_for_model_and_policy_apart():
    update = TDMPCUpdate(make_told(), TDMPCConfig(max_grad_norm=1e-3))
    update(make_slices())
    for parameters in update._clipped:
        norm = torch.stack([p.grad.norm() for p in parameters]).norm()
        assert norm.item() == pytest.approx(1e-3, rel=1e-3)


def test_an_update_goes_on_from_its_state():
    ours, theirs = (TDMPCUpdate(make_told(seed), TDMPCConfig()) for seed in (0, 1))
    for seed in range(3):
        ours(make_slices(seed=seed), generator=torch.Generator().manual_seed(seed))
    theirs.load_state_dict(ours.state_dict())
    for update in (ours, theirs):
        update(make_slices(seed=9), generator=torch.Generator().manual_seed(9))
    for a, b in zip(ours.loss.parameters(), theirs.loss.parameters(), strict=True):
        assert torch.equal(a, b)


def test_learning_beyond_chance_on_a_tiny_problem():
    """One step, reward -(a - o)^2: the best action is the observation, here within ±1."""
    torch.manual_seed(0)
    told = TOLD(1, [1.0], TOLDConfig(latent_dim=4, encoder_dim=16, mlp_dim=32), terminates=True)
    config = TDMPCConfig(loss=TDMPCLossConfig(value_coef=1.0))
    update = TDMPCUpdate(told, config)
    generator = torch.Generator().manual_seed(0)
    for _ in range(400):
        observation, action = (2 * torch.rand(64, 1, 1, generator=generator) - 1 for _ in range(2))
        update(
            TensorDict(
                observation=observation,
                action=action,
                valid=torch.ones(64, 1, dtype=torch.bool),
                next=TensorDict(
                    observation=observation,
                    reward=-(action - observation).square(),
                    terminated=torch.ones(64, 1, 1, dtype=torch.bool),
                    batch_size=[64, 1],
                ),
                batch_size=[64, 1],
            ),
            generator=generator,
        )
    observation = torch.linspace(-0.9, 0.9, 50).unsqueeze(-1)
    error = (told.policy(told.encode(observation)) - observation).square().mean()
    assert error < 0.05  # doing nothing costs 0.28, acting at random 0.6
    _, _, terminated = told.transition(told.encode(observation), torch.zeros(50, 1))
    assert terminated.all()


# Replay.


def episode(length, start=0.0, terminated=True, dim=1):
    """Observations count up from ``start``, so that a slice tells where it comes from."""
    count = start + torch.arange(length + 1, dtype=torch.float32).unsqueeze(-1)
    ends = torch.zeros(length, 1, dtype=torch.bool)
    ends[-1] = terminated
    return TensorDict(
        observation=count[:-1].expand(-1, dim),
        action=torch.zeros(length, 1),
        next=TensorDict(
            observation=count[1:].expand(-1, dim),
            reward=torch.ones(length, 1),
            terminated=ends,
            batch_size=[length],
        ),
        batch_size=[length],
    )


def make_replay(capacity=1000, batch_size=256, seed=0, **kwargs):
    generator = torch.Generator().manual_seed(seed)
    return EpisodeReplay(capacity, 5, batch_size, generator=generator, **kwargs)


def check_slices(slices, lengths):
    """Slices lie in one episode each, in order, and what follows its end is marked as padding."""
    valid = slices["valid"]
    first = slices["observation"][:, 0, 0]
    assert valid[:, 0].all()
    expected = first[:, None] + torch.arange(5)
    assert torch.equal(slices["observation"][..., 0][valid], expected[valid])
    length = torch.tensor(lengths)[(first // 1000).long()].unsqueeze(-1)
    assert torch.equal(valid, expected % 1000 < length)
    assert torch.equal(slices["next", "terminated"][..., 0], expected % 1000 + 1 == length)
    return first


def test_slices_never_cross_episodes_and_may_start_anywhere():
    lengths, replay = [7, 1, 3, 20], make_replay()
    for i, length in enumerate(lengths):
        replay.extend(episode(length, 1000.0 * i))
    starts = set()
    for _ in range(8):
        starts |= set(check_slices(replay.sample(), lengths).tolist())
    assert starts == {1000.0 * i + k for i, n in enumerate(lengths) for k in range(n)}


def test_slices_stay_whole_when_old_episodes_make_room():
    lengths, replay = [7, 11, 3, 20, 9, 4, 13], make_replay(capacity=50)
    for i, length in enumerate(lengths):
        replay.extend(episode(length, 1000.0 * i))
        for _ in range(3):
            check_slices(replay.sample(), lengths)
    assert len(replay) == 50


def test_priorities_and_importance_weights_by_hand():
    """Priorities 1, 2, 3, 4 to the power 0.5; weights are (p / sum p)^-1, greatest 1."""
    replay = make_replay(alpha=0.5, beta=1.0, batch_size=4000)
    replay.extend(episode(4))
    index = torch.arange(4)
    replay.sampler.update_priority(index, torch.tensor([1.0, 2.0, 3.0, 4.0]))
    slices = replay.sample()
    start = slices["observation"][:, 0, 0].long()
    power = torch.tensor([1.0, 2.0, 3.0, 4.0]).sqrt()
    shares = torch.bincount(start, minlength=4) / 4000
    torch.testing.assert_close(shares, power / power.sum(), atol=0.03, rtol=0)
    torch.testing.assert_close(slices["priority_weight"][:, 0], (1 / power)[start])


def test_new_slices_have_the_highest_priority_so_far():
    replay = make_replay()
    replay.extend(episode(4))
    slices = replay.sample()
    replay.update_priority(slices, torch.full((256,), 5.0))
    replay.update_priority(slices[:1], torch.full((1,), 0.5))
    replay.extend(episode(4, 1000.0))
    priorities = replay.state_dict()["sampler"]["priorities"]
    torch.testing.assert_close(
        priorities[8:12], torch.full((4,), 5.0**0.6, dtype=torch.float64), rtol=1e-4, atol=0
    )


def test_uniform_without_alpha():
    replay = make_replay(alpha=0.0, batch_size=4000)
    replay.extend(episode(4))
    replay.sampler.update_priority(torch.arange(4), torch.tensor([1.0, 2.0, 3.0, 400.0]))
    slices = replay.sample()
    shares = torch.bincount(slices["observation"][:, 0, 0].long(), minlength=4) / 4000
    torch.testing.assert_close(shares, torch.full((4,), 0.25), atol=0.03, rtol=0)
    assert (slices["priority_weight"] == 1).all()


def test_replay_goes_on_from_its_state():
    ours, theirs = make_replay(capacity=50), make_replay(capacity=50, seed=7)
    for i, length in enumerate([7, 11, 3, 20, 9]):
        ours.extend(episode(length, 1000.0 * i))
    slices = ours.sample()
    ours.update_priority(slices, torch.rand(256, generator=torch.Generator().manual_seed(1)))
    theirs.load_state_dict(ours.state_dict())
    samples = []
    for replay in (ours, theirs):
        replay.buffer.set_rng(torch.Generator().manual_seed(3))
        replay.extend(episode(6, 5000.0))
        samples.append(replay.sample())
    assert (samples[0] == samples[1]).all()


def test_the_sampler_is_torchrls_with_another_inside():
    from torchrl.data import PrioritizedSliceSampler

    assert issubclass(TensorPrioritizedSliceSampler, PrioritizedSliceSampler)
