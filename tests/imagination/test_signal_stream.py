"""References of imagined worlds: endless, through their lives, and the same after a resume."""

from __future__ import annotations

from dataclasses import replace

import torch

from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.imagination import Rollouts, SignalStream, make_start_states
from phihp_torchrl.imagination.rollouts import Worlds, draw_noise
from tests.followed import AIM, disturbed, followed

TASK = followed(reference=replace(AIM, preview=2))


def stream_of(seed=0, worlds=4):
    return SignalStream(TASK, worlds, torch.Generator().manual_seed(seed))


def test_windows_move_up_one_row_a_step():
    stream = stream_of()
    windows = torch.cat([stream.present()[None], stream.advance(300)])
    assert windows[1:, :, :2].equal(windows[:-1, :, 1:])


def test_a_stream_has_no_end_and_draws_anew():
    windows = stream_of().advance(1200)
    assert windows.shape == (1200, 4, 3)
    assert not windows[:499].equal(windows[500:999])


def test_a_stream_goes_on_from_its_state():
    stream, other = stream_of(), stream_of(seed=1)
    stream.advance(30)
    other.load_state_dict(stream.state_dict())
    assert other.advance(20).equal(stream.advance(20))


def step_worlds(max_age, policy=None):
    model = TaskWorldModel(TASK, HybridDynamics.pure_prior(TASK))

    def act(weights, observation, bounds):
        return torch.zeros_like(observation[..., :1])

    generator = torch.Generator().manual_seed(0)
    rollouts = Rollouts(model, policy or act, max_age=max_age)
    stream = stream_of()
    state = TASK.with_signals(TASK.sample_start([4], generator), stream.present())
    starts = make_start_states(TASK).sample([12, 4], generator)
    noise = draw_noise(
        starts,
        TASK.bounds,
        std=0.1,
        random_fraction=0.0,
        generator=generator,
        signals=(windows := stream.advance(12)),
    )
    return (*rollouts.chunk([], Worlds(state, torch.zeros(4, dtype=torch.long)), noise), windows)


def test_signals_go_on_when_a_life_ends():
    batch, worlds, windows = step_worlds(max_age=5)
    following = batch.next_state.view(12, 4, -1)
    assert following[..., 2:].equal(windows)
    # Lives end after 5 steps, when the position jumps and the reference does not.
    state = batch.state.view(12, 4, -1)
    assert state[1:, :, 2:].equal(windows[:-1])
    assert not state[5, :, :2].equal(following[4, :, :2])
    assert worlds.state[:, 2:].equal(windows[-1])


def test_returns_follow_the_signals_they_are_given():
    model = TaskWorldModel(TASK, HybridDynamics.pure_prior(TASK))
    rollouts = Rollouts(model, lambda w, o, b: torch.zeros_like(o[..., :1]), max_age=20)
    state = torch.zeros(1, 5)
    assert rollouts.returns([], state, 8).total.item() == 0.0
    moved = torch.full([8, 1, 3], 0.5)  # known after the first step, so missed in seven
    assert rollouts.returns([], state, 8, signals=moved).total.item() == -7 * 0.25


def test_start_states_have_random_signals_and_disturbances():
    task = disturbed(coverage=TASK.reset)
    starts = make_start_states(task).sample([2000], torch.Generator().manual_seed(0))
    reference, drift = starts[:, 2], starts[:, 3]
    assert reference.abs().max() <= 1.0
    assert reference.std() > 0.5
    assert drift.abs().max() <= 3.0
    assert 0.1 < drift.eq(0).float().mean() < 0.4  # an episode starts without an estimate
