"""Replay of slices of episodes: where they lie, how they are drawn, and that it goes on."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torchrl.data import PrioritizedSliceSampler

from phihp_torchrl.tdmpc import EpisodeReplay, TensorPrioritizedSliceSampler


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
    assert issubclass(TensorPrioritizedSliceSampler, PrioritizedSliceSampler)
