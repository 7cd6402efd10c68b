"""Imagined chunks are the model's own transitions, and returns are sums of its rewards."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from lopsided import LOPSIDED
from tensordict.nn import TensorDictModule
from torch import nn

from phihp_torchrl import HybridDynamics, WorldModelEnv, get_task
from phihp_torchrl.agents import Actor, act
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import (
    Batch,
    ChunkNoise,
    Returns,
    Rollouts,
    Worlds,
    draw_noise,
    step_worlds,
    sum_rewards,
)
from phihp_torchrl.tasks import ActionBounds, find_task, list_tasks
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

WORLDS, STEPS = 6, 5
UNIT = ActionBounds.from_limits((-1.0,), (1.0,))


def make(task="pendulum"):
    task = find_task(task)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task)).requires_grad_(False)
    actor = [p.detach() for p in Actor(task, (16, 16)).mlp.parameters()]
    return model, actor, task.bounds


def start(model, count=WORLDS):
    return Worlds(model.task.reset.sample([count]), torch.zeros(count, dtype=torch.int64))


def silent(model, steps=STEPS, worlds=WORLDS):
    """No noise at all, and resets to a place of its own for each step and world."""
    n, m = model.task.state_dim, model.task.action_dim
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
    model, actor, bounds = make(name)
    places = model.task.reset.sample([STEPS, WORLDS])
    noise = draw_noise(places, bounds, std=0.3, random_fraction=0.2)
    batch, worlds = step_worlds(model, act, actor, start(model), noise, bounds, max_age=3)
    assert batch.reward.shape == batch.terminated.shape == (STEPS * WORLDS,)
    next_state, reward, terminated = model.transition(batch.state, batch.action)
    torch.testing.assert_close(batch.next_state, next_state)
    torch.testing.assert_close(batch.reward, reward)
    assert torch.equal(batch.terminated, terminated)
    assert worlds.state.shape == (WORLDS, model.task.state_dim)


def test_without_noise_the_policy_acts_and_time_goes_on():
    model, actor, bounds = make()
    worlds = start(model)
    batch, after = step_worlds(model, act, actor, worlds, silent(model), bounds, max_age=100)
    state = worlds.state
    for part in by_step(batch):
        assert torch.equal(part.state, state)
        torch.testing.assert_close(part.action, act(actor, model.observe(state), bounds))
        state = part.next_state
    assert torch.equal(after.state, state)
    assert (after.age == STEPS).all()


def part_of(noise, steps):
    """The noise of some steps; there are no signals."""
    return ChunkNoise(*(part if part is None else part[steps] for part in noise))


def test_two_chunks_are_one_longer_chunk():
    model, actor, bounds = make("cartpole")
    worlds = start(model)
    noise = draw_noise(
        model.task.reset.sample([STEPS, WORLDS]), bounds, std=0.5, random_fraction=0.5
    )
    whole, expected = step_worlds(model, act, actor, worlds, noise, bounds, max_age=3)
    first, middle = step_worlds(
        model,
        act,
        actor,
        worlds,
        part_of(noise, slice(2)),
        bounds,
        3,
    )
    second, end = step_worlds(
        model,
        act,
        actor,
        middle,
        part_of(noise, slice(2, None)),
        bounds,
        3,
    )
    for column, one, two in zip(whole, first, second, strict=True):
        assert torch.equal(column, torch.cat([one, two]))
    assert torch.equal(end.state, expected.state)
    assert torch.equal(end.age, expected.age)


# Ends


def test_old_worlds_are_truncated_not_terminated():
    model, actor, bounds = make()
    worlds = Worlds(start(model).state, torch.tensor([0, 1, 2, 3, 4, 5]))
    noise = silent(model)
    batch, after = step_worlds(model, act, actor, worlds, noise, bounds, max_age=6)
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
    model, actor, bounds = make("cartpole")
    worlds = start(model)
    worlds.state[2] = torch.tensor([2.39, 5.0, 0.0, 0.0])  # about to leave the track
    noise = silent(model)
    batch, after = step_worlds(model, act, actor, worlds, noise, bounds, max_age=100)
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
    model = TaskWorldModel(task, Explosive(SimulatedWorld(task).oracle(), value))
    _, actor, bounds = make()
    worlds = Worlds(torch.zeros(WORLDS, 2), torch.zeros(WORLDS, dtype=torch.int64))
    worlds.state[3, 0] = 1.5
    noise = silent(model)
    batch, after = step_worlds(model, act, actor, worlds, noise, bounds, max_age=100)
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
    model = SimulatedWorld(task).model()
    _, actor, bounds = make()
    worlds = Worlds(torch.tensor([[1.0, 0.0], [0.5, 0.0]]), torch.zeros(2, dtype=torch.int64))
    batch, _ = step_worlds(model, act, actor, worlds, silent(model, 2, 2), bounds, max_age=100)
    assert batch.reward.isfinite().all()
    assert batch.terminated[:2].tolist() == [True, False]


# Splitting


@pytest.mark.parametrize("name", ["cartpole", "acrobot-swingup"])
def test_splitting_the_worlds_changes_nothing(name):
    model, actor, bounds = make(name)
    worlds = start(model)
    places = model.task.reset.sample([STEPS, WORLDS])
    noise = draw_noise(places, bounds, std=0.3, random_fraction=0.3)
    batch, after = step_worlds(model, act, actor, worlds, noise, bounds, max_age=3)
    steps = by_step(batch)
    for i in range(0, WORLDS, 2):
        ours = slice(i, i + 2)
        some = ChunkNoise(*(part if part is None else part[:, ours] for part in noise))
        part = Worlds(*(column[ours] for column in worlds))
        found, ends = step_worlds(model, act, actor, part, some, bounds, max_age=3)
        for step, alone in zip(steps, by_step(found), strict=True):
            for column, own in zip(step, alone, strict=True):
                torch.testing.assert_close(own, column[ours])
        torch.testing.assert_close(ends.state, after.state[ours])
        assert torch.equal(ends.age, after.age[ours])


def test_splitting_the_states_of_returns_changes_nothing():
    model, actor, _ = make("cartpole")
    state = model.task.coverage.sample([12])
    rollouts = Rollouts(model, act, 9)
    whole = rollouts.returns(actor, state, 7, gamma=0.9).total
    parts = [rollouts.returns(actor, some, 7, gamma=0.9).total for some in state.split(5)]
    torch.testing.assert_close(torch.cat(parts), whole)


# Noise


PERCENT = replace(LOPSIDED, action_low=(0.0,), action_high=(100.0,))


@pytest.mark.parametrize("std", [0.0, 0.3, 10.0])
@pytest.mark.parametrize("task", ["acrobot-swingup", LOPSIDED, PERCENT], ids=["", "-6..12", "0..1"])
def test_actions_stay_in_bounds(task, std):
    model, actor, bounds = make(task)
    noise = draw_noise(model.task.reset.sample([20, 50]), bounds, std=std, random_fraction=0.3)
    batch, _ = step_worlds(model, act, actor, start(model, 50), noise, bounds, max_age=100)
    assert ((batch.action >= bounds.low) & (batch.action <= bounds.high)).all()
    if std > 0:
        assert (batch.action.amax(0) > bounds.from_unit(torch.tensor(0.9))).all()
        assert (batch.action.amin(0) < bounds.from_unit(torch.tensor(-0.9))).all()


def test_exploration_is_in_units_of_the_bounds():
    model, actor, bounds = make("cartpole")
    noise = draw_noise(torch.zeros(50, 100, 4), bounds, std=0.2, random_fraction=0.0)
    assert not noise.use_random.any()
    assert noise.exploration.std().item() == pytest.approx(0.2, rel=0.05)
    actor = [torch.zeros_like(layer) for layer in actor]
    batch, _ = step_worlds(model, act, actor, start(model, 100), noise, bounds, max_age=100)
    assert batch.action.std().item() == pytest.approx(0.2 * 10.0, rel=0.05)


@pytest.mark.parametrize("task", ["cartpole", LOPSIDED, PERCENT], ids=["", "-6..12", "0..1"])
def test_random_actions_are_uniform(task):
    model, actor, bounds = make(task)
    noise = draw_noise(model.task.reset.sample([50, 100]), bounds, std=0.1, random_fraction=1.0)
    assert noise.use_random.all()
    batch, _ = step_worlds(model, act, actor, start(model, 100), noise, bounds, max_age=100)
    assert torch.equal(batch.action, noise.random_actions.flatten(0, 1))
    scaled = bounds.to_unit(batch.action).flatten()
    assert scaled.abs().max() <= 1
    counts = torch.histc(scaled, 10, -1, 1)
    assert (counts - 500).abs().max() < 100  # 4.7 standard deviations


def test_random_fraction_is_a_share():
    noise = draw_noise(torch.zeros(100, 100, 2), UNIT, std=0.1, random_fraction=0.25)
    assert noise.use_random.float().mean().item() == pytest.approx(0.25, abs=0.02)


def test_noise_is_reproducible():
    def draw(seed):
        generator = torch.Generator().manual_seed(seed)
        return draw_noise(
            torch.zeros(3, 4, 2), UNIT, std=0.1, random_fraction=0.5, generator=generator
        )

    before = torch.get_rng_state()
    first, again, other = draw(0), draw(0), draw(1)
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(a, b) for a, b in zip(first[:4], again[:4], strict=True))
    assert not torch.equal(first.exploration, other.exploration)


def test_a_chunk_is_one_graph():
    model, actor, bounds = make("cartpole")
    noise = draw_noise(model.task.reset.sample([2, 4]), bounds, std=0.1, random_fraction=0.5)
    arguments = (model, act, actor, start(model, 4), noise, bounds, 100)
    with torch.no_grad():
        compiled = torch.compile(step_worlds, fullgraph=True, backend="eager")(*arguments)
        for one, other in zip(compiled[0], step_worlds(*arguments)[0], strict=True):
            torch.testing.assert_close(one, other)


@pytest.mark.slow
def test_compiled_by_inductor_equals_eager(monkeypatch):
    monkeypatch.setattr(Rollouts, "_RETURN_STEPS", 2)  # machine code for more takes a minute
    model, actor, bounds = make()
    eager, compiled = (Rollouts(model, act, 3, compile=c) for c in (False, True))
    worlds = start(model)
    with torch.no_grad(), torch._dynamo.config.patch(error_on_recompile=True):
        for _ in range(2):
            noise = draw_noise(
                model.task.reset.sample([2, WORLDS]), bounds, std=0.1, random_fraction=0.2
            )
            expected = eager.chunk(actor, worlds, noise)
            torch.testing.assert_close(compiled.chunk(actor, worlds, noise), expected)
            worlds = expected[1]
            # 5 steps: two compiled chunks and a rest.
            returns = (x.returns(actor, worlds.state, 5).total for x in (compiled, eager))
            torch.testing.assert_close(*returns, rtol=1e-4, atol=1e-4)
            actor[0].mul_(0.9)


def test_what_cannot_compile_says_so(caplog):
    task = get_task("pendulum")
    model = SimulatedWorld(task, SimulatedConfig(integrator="dopri5")).model()
    rollouts = Rollouts(model, act, 3, compile=True)
    assert "not compiled" in caplog.text
    actor = [p.detach() for p in Actor(task, (4,)).mlp.parameters()]
    assert rollouts.returns(actor, task.reset.sample([2]), 6).total.shape == (2,)


# Returns


@pytest.mark.parametrize("steps", [3, 5, 13])
def test_returns_in_chunks_are_the_whole(steps):
    model, actor, bounds = make("cartpole")
    state = model.task.coverage.sample([20])
    values = Rollouts(model, act, 9).returns(actor, state, steps)
    whole = sum_rewards(model, act, actor, Returns.from_state(state, bounds), bounds, steps)
    for one, other in zip(values, whole, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("name", list_tasks())
def test_return_is_that_of_the_env(name):
    model, actor, _ = make(name)
    task, steps = model.task, 30
    actor_module = TensorDictModule(Actor.from_layers(task, actor), ["observation"], ["action"])
    env = WorldModelEnv(model, batch_size=[WORLDS])
    state = task.reset.sample([WORLDS])
    first = env.reset(env.reset().set("state", state), set_state=True)
    with torch.no_grad():
        rollout = env.rollout(
            steps, actor_module, tensordict=first, auto_reset=False, break_when_any_done=False
        )
        values = Rollouts(model, act, 9).returns(actor, state, steps).total
    rewards, done = rollout["next", "reward"][..., 0], rollout["next", "done"][..., 0]
    for world in range(WORLDS):
        ends = done[world].nonzero()
        last = ends[0].item() + 1 if len(ends) else steps
        expected = rewards[world, :last].sum().item()
        assert values[world].item() == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_nothing_is_earned_after_the_end():
    model, actor, _ = make("cartpole")
    state = torch.tensor([[2.39, 5.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    values = Rollouts(model, act, 9).returns(actor, state, 3).total
    assert values.tolist() == [1.0, 3.0], "the failing step counts, as in the world"


@pytest.mark.parametrize("gamma", [1.0, 0.9])
def test_rewards_are_discounted_until_the_end(gamma):
    model, actor, bounds = make("cartpole")
    state = torch.tensor([[2.39, 5.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    returns = Returns.from_state(state, bounds)
    for steps in (1, 2):
        returns = sum_rewards(model, act, actor, returns, bounds, steps, gamma)
    assert returns.total.tolist() == pytest.approx([1.0, 1 + gamma + gamma**2])
    assert returns.weight.tolist() == pytest.approx([0.0, gamma**3])
    whole = Rollouts(model, act, 9).returns(actor, state, 3, gamma)
    torch.testing.assert_close(whole, returns)


def test_changes_of_the_action_are_summed_until_the_end():
    model, _, bounds = make("cartpole")
    state = torch.tensor([[2.39, 5.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    actions = iter([1.0, -1.0, 0.0, 0.5])

    def policy(weights, observation, bounds):
        return bounds.from_unit(torch.full((2, 1), next(actions)))

    returns = Returns.from_state(state, bounds)
    for steps in (1, 3):
        returns = sum_rewards(model, policy, [], returns, bounds, steps)
    assert returns.change.tolist() == pytest.approx([0.0, 3.5]), "the first ends at once"
