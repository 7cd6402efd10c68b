"""Uniform replay in one flat tensor: what is kept, what is drawn, and that it goes on."""

from __future__ import annotations

import copy

import pytest
import torch

from phihp_torchrl.agents import FlatReplay
from phihp_torchrl.imagination import Batch


def numbered(first, last):
    """Transitions whose every entry tells their number."""
    number = torch.arange(first, last).float()
    return Batch(
        torch.stack([number, -number], -1),
        10 * number.unsqueeze(-1),
        100 * number,
        torch.stack([number + 0.5, -number], -1),
        number % 2 == 0,
    )


def kept(replay):
    rows = replay.rows[: len(replay)]
    return sorted(rows[:, 0].int().tolist())


def test_replay_returns_what_it_was_given():
    replay = FlatReplay(20, 2, 1)
    replay.extend(numbered(0, 10))
    assert len(replay) == replay.written == 10
    sample = replay.sample(50)
    number = sample.state[:, 0]
    expected = numbered(0, 10)
    for column, given in zip(sample, expected, strict=True):
        assert torch.equal(column, given[number.long()])
        assert column.dtype == given.dtype


@pytest.mark.parametrize("sizes", [[4, 4, 4, 4], [7, 7], [10, 3], [1] * 25, [9, 10, 2]])
def test_oldest_make_room(sizes):
    replay, written = FlatReplay(10, 2, 1), 0
    for size in sizes:
        replay.extend(numbered(written, written + size))
        written += size
        assert kept(replay) == list(range(max(0, written - 10), written))
        assert replay.written == written
        assert len(replay) == min(written, 10)


@pytest.mark.parametrize("before", [0, 3, 12])
def test_more_than_all_the_room(before):
    replay = FlatReplay(10, 2, 1)
    replay.extend(numbered(0, before))
    replay.extend(numbered(before, before + 25))
    assert kept(replay) == list(range(before + 15, before + 25))
    assert replay.written == before + 25
    replay.extend(numbered(before + 25, before + 29))
    assert kept(replay) == list(range(before + 19, before + 29))


def test_sampling_is_uniform_and_reproducible():
    replay = FlatReplay(30, 2, 1)
    replay.extend(numbered(0, 20))
    numbers = replay.sample(20_000, torch.Generator().manual_seed(0)).state[:, 0]
    counts = torch.bincount(numbers.long(), minlength=30)
    assert (counts[20:] == 0).all(), "empty rows are never drawn"
    assert (counts[:20] - 1000).abs().max() < 160  # 5 standard deviations
    again = replay.sample(20_000, torch.Generator().manual_seed(0)).state[:, 0]
    assert torch.equal(numbers, again)


def test_replay_state_dict():
    one, other = FlatReplay(10, 2, 1), FlatReplay(10, 2, 1)
    one.extend(numbered(0, 13))
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    assert len(other) == 10
    assert other.written == 13
    for replay in (one, other):
        replay.extend(numbered(13, 16))
    assert torch.equal(one.rows, other.rows)
    draws = [replay.sample(8, torch.Generator().manual_seed(0)) for replay in (one, other)]
    assert all(torch.equal(a, b) for a, b in zip(*draws, strict=True))


def test_empty_replay():
    with pytest.raises(RuntimeError, match="empty"):
        FlatReplay(10, 2, 1).sample(1)


def test_replay_without_room():
    with pytest.raises(ValueError, match="capacity"):
        FlatReplay(0, 2, 1)
