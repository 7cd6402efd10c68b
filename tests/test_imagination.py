"""Imagined chunks are the model's own transitions, and the replay keeps the newest of them."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from phihp_torchrl import HybridDynamics, WorldModelEnv, get_task
from phihp_torchrl.agents import (
    Actor,
    Batch,
    ChunkNoise,
    FlatReplay,
    Imagination,
    Worlds,
    draw_noise,
    imagine,
    imagined_return,
)
from phihp_torchrl.agents.functional import policy
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.tasks import list_tasks

WORLDS, STEPS = 6, 5


def make(name="pendulum"):
    task = get_task(name)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task)).requires_grad_(False)
    actor = [p.detach() for p in Actor(task, (16, 16)).mlp.parameters()]
    return model, actor, torch.tensor(task.action_high)


def start(model, count=WORLDS):
    return Worlds(model.task.reset.sample([count]), torch.zeros(count, dtype=torch.int64))


def silent(model, steps=STEPS, worlds=WORLDS):
    """No noise at all, and resets to a place of its own for each step and world."""
    n, m = model.task.system.state_dim, model.task.system.action_dim
    places = 0.01 * torch.randn(steps, worlds, n)
    return ChunkNoise(
        places,
        torch.zeros(steps, worlds, m),
        torch.zeros(steps, worlds, m),
        torch.zeros(steps, worlds, dtype=torch.bool),
    )


def by_step(batch, steps=STEPS):
    return [Batch(*part) for part in zip(*(column.chunk(steps) for column in batch), strict=True)]


# Transitions


@pytest.mark.parametrize("name", list_tasks())
def test_transitions_are_those_of_the_model(name):
    model, actor, high = make(name)
    places = model.task.reset.sample([STEPS, WORLDS])
    noise = draw_noise(places, high, std=0.3, random_fraction=0.2)
    batch, worlds = imagine(model, actor, start(model), noise, high, max_age=3)
    assert batch.reward.shape == batch.terminated.shape == (STEPS * WORLDS,)
    next_state, reward, terminated = model.transition(batch.state, batch.action)
    torch.testing.assert_close(batch.next_state, next_state)
    torch.testing.assert_close(batch.reward, reward)
    assert torch.equal(batch.terminated, terminated)
    assert worlds.state.shape == (WORLDS, model.task.system.state_dim)


def test_without_noise_the_policy_acts_and_time_goes_on():
    model, actor, high = make()
    worlds = start(model)
    batch, after = imagine(model, actor, worlds, silent(model), high, max_age=100)
    state = worlds.state
    for part in by_step(batch):
        assert torch.equal(part.state, state)
        torch.testing.assert_close(part.action, policy(actor, model.observe(state), high))
        state = part.next_state
    assert torch.equal(after.state, state)
    assert (after.age == STEPS).all()


def test_two_chunks_are_one_longer_chunk():
    model, actor, high = make("cartpole")
    worlds = start(model)
    noise = draw_noise(model.task.reset.sample([STEPS, WORLDS]), high, std=0.5, random_fraction=0.5)
    whole, expected = imagine(model, actor, worlds, noise, high, max_age=3)
    first, middle = imagine(model, actor, worlds, ChunkNoise(*(n[:2] for n in noise)), high, 3)
    second, end = imagine(model, actor, middle, ChunkNoise(*(n[2:] for n in noise)), high, 3)
    for column, one, two in zip(whole, first, second, strict=True):
        assert torch.equal(column, torch.cat([one, two]))
    assert torch.equal(end.state, expected.state)
    assert torch.equal(end.age, expected.age)


# Ends


def test_old_worlds_are_truncated_not_terminated():
    model, actor, high = make()
    worlds = Worlds(start(model).state, torch.tensor([0, 1, 2, 3, 4, 5]))
    noise = silent(model)
    batch, after = imagine(model, actor, worlds, noise, high, max_age=6)
    assert not batch.terminated.any()
    parts = by_step(batch)
    # World 5 has one step to live, world 1 five; world 0 lives on.
    for world in range(1, 6):
        last = 5 - world
        if last + 1 < STEPS:
            assert torch.equal(parts[last + 1].state[world], noise.start_states[last, world])
            assert not torch.equal(parts[last].next_state[world], noise.start_states[last, world])
    assert after.age.tolist() == [5, 0, 1, 2, 3, 4]
    assert torch.equal(after.state[1], noise.start_states[4, 1])


def test_terminated_worlds_start_anew():
    model, actor, high = make("cartpole")
    worlds = start(model)
    worlds.state[2] = torch.tensor([2.39, 5.0, 0.0, 0.0])  # about to leave the track
    noise = silent(model)
    batch, after = imagine(model, actor, worlds, noise, high, max_age=100)
    parts = by_step(batch)
    assert parts[0].terminated.tolist() == [False, False, True, False, False, False]
    assert parts[0].next_state[2, 0] > 2.4, "the end itself is recorded"
    assert torch.equal(parts[1].state[2], noise.start_states[0, 2])
    assert after.age.tolist() == [5, 5, 4, 5, 5, 5]


class Explosive(nn.Module):
    """A model that knows no numbers above 1."""

    def __init__(self, dynamics, value):
        super().__init__()
        self.dynamics, self.value = dynamics, value

    def forward(self, state, action):
        bad = state[..., :1] > 1.0
        return torch.where(bad, self.value, self.dynamics(state, action))


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_non_finite_transitions_do_no_harm(value):
    task = get_task("pendulum")
    model = TaskWorldModel(task, Explosive(HybridDynamics.oracle(task), value))
    _, actor, high = make()
    worlds = Worlds(torch.zeros(WORLDS, 2), torch.zeros(WORLDS, dtype=torch.int64))
    worlds.state[3, 0] = 1.5
    noise = silent(model)
    batch, after = imagine(model, actor, worlds, noise, high, max_age=100)
    assert all(column.isfinite().all() for column in batch)
    first = by_step(batch)[0]
    assert first.terminated.tolist() == [False, False, False, True, False, False]
    assert torch.equal(first.next_state[3], first.state[3])
    assert first.reward[3] == 0
    assert torch.equal(by_step(batch)[1].state[3], noise.start_states[0, 3])
    assert after.state.isfinite().all()


def test_non_finite_rewards_do_no_harm():
    def reward(state, action, next_state):
        return 1.0 / (state[..., 0] - 1.0)

    task = replace(get_task("pendulum"), reward=reward)
    model = TaskWorldModel(task, HybridDynamics.oracle(task))
    _, actor, high = make()
    worlds = Worlds(torch.tensor([[1.0, 0.0], [0.5, 0.0]]), torch.zeros(2, dtype=torch.int64))
    batch, _ = imagine(model, actor, worlds, silent(model, 2, 2), high, max_age=100)
    assert batch.reward.isfinite().all()
    assert batch.terminated[:2].tolist() == [True, False]


# Noise


@pytest.mark.parametrize("std", [0.0, 0.3, 10.0])
def test_actions_stay_in_bounds(std):
    model, actor, high = make("acrobot-swingup")
    noise = draw_noise(model.task.reset.sample([20, 50]), high, std=std, random_fraction=0.3)
    batch, _ = imagine(model, actor, start(model, 50), noise, high, max_age=100)
    assert (batch.action.abs() <= high).all()


def test_exploration_is_in_units_of_the_bounds():
    model, actor, high = make("cartpole")
    noise = draw_noise(torch.zeros(50, 100, 4), high, std=0.2, random_fraction=0.0)
    assert not noise.use_random.any()
    assert noise.exploration.std().item() == pytest.approx(0.2, rel=0.05)
    actor = [torch.zeros_like(layer) for layer in actor]
    batch, _ = imagine(model, actor, start(model, 100), noise, high, max_age=100)
    assert batch.action.std().item() == pytest.approx(0.2 * 10.0, rel=0.05)


def test_random_actions_are_uniform():
    model, actor, high = make("cartpole")
    noise = draw_noise(model.task.reset.sample([50, 100]), high, std=0.1, random_fraction=1.0)
    assert noise.use_random.all()
    batch, _ = imagine(model, actor, start(model, 100), noise, high, max_age=100)
    assert torch.equal(batch.action, noise.random_actions.flatten(0, 1))
    scaled = batch.action.flatten() / high
    assert scaled.abs().max() <= 1
    counts = torch.histc(scaled, 10, -1, 1)
    assert (counts - 500).abs().max() < 100  # 4.7 standard deviations


def test_random_fraction_is_a_share():
    noise = draw_noise(torch.zeros(100, 100, 2), torch.ones(1), std=0.1, random_fraction=0.25)
    assert noise.use_random.float().mean().item() == pytest.approx(0.25, abs=0.02)


def test_noise_is_reproducible():
    def draw(seed):
        generator = torch.Generator().manual_seed(seed)
        return draw_noise(
            torch.zeros(3, 4, 2), torch.ones(1), std=0.1, random_fraction=0.5, generator=generator
        )

    before = torch.get_rng_state()
    first, again, other = draw(0), draw(0), draw(1)
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first.exploration, other.exploration)


def test_a_chunk_is_one_graph():
    model, actor, high = make("cartpole")
    noise = draw_noise(model.task.reset.sample([2, 4]), high, std=0.1, random_fraction=0.5)
    arguments = (model, actor, start(model, 4), noise, high, 100)
    with torch.no_grad():
        compiled = torch.compile(imagine, fullgraph=True, backend="eager")(*arguments)
        for one, other in zip(compiled[0], imagine(*arguments)[0], strict=True):
            torch.testing.assert_close(one, other)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pendulum", "acrobot-swingup"])
def test_compiled_by_inductor_equals_eager(name):
    model, actor, high = make(name)
    eager, compiled = (Imagination(model, high, 3, compile=c) for c in (False, True))
    worlds = start(model)
    with torch.no_grad(), torch._dynamo.config.patch(error_on_recompile=True):
        for _ in range(2):
            noise = draw_noise(
                model.task.reset.sample([STEPS, WORLDS]), high, std=0.1, random_fraction=0.2
            )
            expected = eager.chunk(actor, worlds, noise)
            torch.testing.assert_close(compiled.chunk(actor, worlds, noise), expected)
            worlds = expected[1]
            # 12 steps: two compiled chunks and a rest.
            returns = (x.returns(actor, worlds.state, 12).total for x in (compiled, eager))
            torch.testing.assert_close(*returns, rtol=1e-4, atol=1e-4)
            actor[0].mul_(0.9)


def test_what_cannot_compile_says_so(caplog):
    task = get_task("pendulum")
    model = TaskWorldModel(task, HybridDynamics.oracle(task, integrator="dopri5"))
    imagination = Imagination(model, torch.tensor([2.0]), 3, compile=True)
    assert "not compiled" in caplog.text
    actor = [p.detach() for p in Actor(task, (4,)).mlp.parameters()]
    assert imagination.returns(actor, task.reset.sample([2]), 6).total.shape == (2,)


# Returns


@pytest.mark.parametrize("steps", [3, 5, 13])
def test_returns_in_chunks_are_the_whole(steps):
    model, actor, high = make("cartpole")
    state = model.task.coverage.sample([20])
    values = Imagination(model, high, 9).returns(actor, state, steps).total
    assert torch.equal(values, imagined_return(model, actor, state, high, steps))


@pytest.mark.parametrize("name", list_tasks())
def test_return_is_that_of_the_env(name):
    model, actor, high = make(name)
    task, steps = model.task, 30
    actor_module = TensorDictModule(Actor.from_layers(task, actor), ["observation"], ["action"])
    env = WorldModelEnv(model, batch_size=[WORLDS])
    state = task.reset.sample([WORLDS])
    first = env.reset(env.reset().set("state", state), set_state=True)
    with torch.no_grad():
        rollout = env.rollout(
            steps, actor_module, tensordict=first, auto_reset=False, break_when_any_done=False
        )
        values = imagined_return(model, actor, state, high, steps)
    rewards, done = rollout["next", "reward"][..., 0], rollout["next", "done"][..., 0]
    for world in range(WORLDS):
        ends = done[world].nonzero()
        last = ends[0].item() + 1 if len(ends) else steps
        expected = rewards[world, :last].sum().item()
        assert values[world].item() == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_nothing_is_earned_after_the_end():
    model, actor, high = make("cartpole")
    state = torch.tensor([[2.39, 5.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    values = imagined_return(model, actor, state, high, 3)
    assert values.tolist() == [1.0, 3.0], "the failing step counts, as in the world"


# Replay


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
