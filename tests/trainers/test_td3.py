"""TD3 on real steps: what is stored, what is counted, what learns, and what must not."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from phihp_torchrl.agents import q_values
from phihp_torchrl.agents.equations import td3_target
from phihp_torchrl.config import ConfigError
from phihp_torchrl.imagination import Batch
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import ActionBounds, Box, Task, get_task
from phihp_torchrl.trainers import ModelTrainer, RealTD3Config, RealTD3Trainer
from phihp_torchrl.worlds import SimulatedWorld

from .trainer_parts import MODEL, REAL, stored


class Sled(System):
    """A mass on ice, pushed."""

    state_names = ("x", "v")
    action_names = ("force",)
    velocity_of = {"x": "v"}
    default_constants = {"mass": 1.0}

    def prior(self, state, action, constants):
        return torch.stack([state[..., 1], action[..., 0] / constants["mass"]], -1)


SLED = Task(
    name="sled",
    system=Sled(),
    action_high=(1.0,),
    time_step=0.2,
    max_steps=25,
    reset=Box((-1.0, -0.5), (1.0, 0.5)),
    reward=lambda state, action, next_state: -next_state[..., 0].square(),
)


def trained(task: Task, config: RealTD3Config, **options) -> RealTD3Trainer:
    torch.manual_seed(0)  # of the networks' initial weights
    trainer = RealTD3Trainer(task, config, seed=0, **options)
    while not trainer.done:
        trainer.advance()
    return trainer


def rows_of(trainer: RealTD3Trainer) -> Batch:
    """All real transitions in their order."""
    return stored(trainer.replay)


# Real steps


def test_what_is_stored_is_what_the_world_did() -> None:
    task = replace(get_task("pendulum"), max_steps=15)
    rows = rows_of(trained(task, REAL))
    assert len(rows.reward) == 60
    step = SimulatedWorld(task).step
    torch.testing.assert_close(step(rows.state, rows.action), rows.next_state)
    torch.testing.assert_close(task.reward(rows.state, rows.action, rows.next_state), rows.reward)
    assert (rows.action.abs() <= 2.0).all()


def test_running_out_of_steps_starts_anew_and_is_no_termination() -> None:
    task = replace(get_task("pendulum"), max_steps=15)
    rows = rows_of(trained(task, REAL))
    assert not rows.terminated.any()
    goes_on = (rows.next_state[:-1] == rows.state[1:]).all(-1)
    assert (~goes_on).nonzero()[:, 0].tolist() == [14, 29, 44]
    low, high = torch.tensor(task.reset.low), torch.tensor(task.reset.high)
    starts = rows.state[[0, 15, 30, 45]]
    assert ((starts >= low) & (starts <= high)).all()


def test_a_fall_is_a_termination_and_starts_anew() -> None:
    task = get_task("cartpole")
    rows = rows_of(
        trained(task, replace(REAL, real_steps=200, random_steps=200, evaluation_interval=200))
    )
    assert rows.terminated.any()
    assert torch.equal(rows.terminated, task.is_terminated(rows.next_state))
    goes_on = (rows.next_state[:-1] == rows.state[1:]).all(-1)
    assert torch.equal(~goes_on, rows.terminated[:-1])
    after = rows.state[1:][rows.terminated[:-1]]
    assert (after.abs() <= 0.05).all()


def test_the_first_steps_are_random_and_the_later_ones_the_actors() -> None:
    config = replace(REAL, real_steps=1000, random_steps=800, exploration_noise=0.0)
    config = replace(
        config, evaluation_interval=1000, last_layer_scale=0.0, actor_learning_rate=1e-9
    )
    rows = rows_of(trained(get_task("pendulum"), config))
    first, later = rows.action[:800, 0], rows.action[800:, 0]
    assert first.abs().max() > 1.9
    assert abs(first.std() - 2.0 * 2.0 / math.sqrt(12)) < 0.1
    assert later.abs().max() < 1e-3  # that actor's only action is zero


def test_updates_are_counted_by_steps() -> None:
    assert trained(SLED, REAL).updates == 40
    assert trained(SLED, replace(REAL, steps_per_update=5)).updates == 8


def test_evaluating_has_no_say_in_the_training() -> None:
    often = trained(SLED, replace(REAL, evaluation_interval=2, evaluation_episodes=5))
    seldom = trained(SLED, replace(REAL, evaluation_interval=60))
    assert torch.equal(often.replay.rows, seldom.replay.rows)
    for ours, theirs in zip(often.update.actor, seldom.update.actor, strict=True):
        assert torch.equal(ours, theirs)


# Learning


def test_the_targets_value_of_a_hand_computed_step() -> None:
    """One linear critic pair and a constant actor, gamma 0.9, by hand."""
    bounds = ActionBounds.from_limits([-2.0], [2.0])
    actor = [torch.zeros(1, 2), torch.tensor([math.atanh(0.5)])]  # acts 0.5 * 2 = 1
    # Q1 = s0 + 2 a, Q2 = s0 + s1 - a, of actions in units of their bounds.
    critics = [
        torch.tensor([[[1.0, 0.0, 2.0]], [[1.0, 1.0, -1.0]]]),
        torch.zeros(2, 1),
    ]
    batch = Batch(
        state=torch.zeros(3, 2),
        action=torch.zeros(3, 1),
        reward=torch.tensor([1.0, 1.0, 1.0]),
        next_state=torch.tensor([[3.0, 0.0], [3.0, 4.0], [3.0, 4.0]]),
        terminated=torch.tensor([False, False, True]),
    )
    noise = torch.tensor([[0.0], [9.0], [0.0]])  # the second acts at the bound, 2
    target = td3_target(batch, actor, critics, noise, bounds, 0.9, lambda state: state)
    # min(3 + 1, 3 + 0 - 0.5) = 2.5; min(3 + 2, 3 + 4 - 1) = 5; nothing after a termination.
    torch.testing.assert_close(target, torch.tensor([1.0 + 0.9 * 2.5, 1.0 + 0.9 * 5.0, 1.0]))
    values = q_values(critics, batch.next_state, torch.ones(3, 1), bounds)
    torch.testing.assert_close(values[:, 0], torch.tensor([4.0, 2.5]))


def test_an_update_moves_actor_critics_and_targets_and_nothing_else() -> None:
    data = replace(MODEL, real_steps=30, steps_per_iteration=30)
    model = ModelTrainer(get_task("pendulum"), data, seed=0)
    model.advance()
    before = {name: value.clone() for name, value in model.dynamics.state_dict().items()}
    trainer = RealTD3Trainer(get_task("pendulum"), REAL, seed=0, transitions=model.transitions())
    loss = trainer.loss
    groups = {
        "actor": loss.actor_network_params,
        "critics": loss.qvalue_network_params,
        "target actor": loss.target_actor_network_params,
        "target critics": loss.target_qvalue_network_params,
    }
    old = {name: group.data.clone() for name, group in groups.items()}
    trainer.advance()
    for name, group in groups.items():
        assert (group.data != old[name]).any(), name
    for name, value in model.dynamics.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_the_replay_starts_with_the_real_steps_of_the_phase_before() -> None:
    data = replace(MODEL, real_steps=40, steps_per_iteration=40)
    model = ModelTrainer(replace(get_task("cartpole"), max_steps=30), data, seed=0)
    model.advance()
    given = model.transitions()
    trainer = RealTD3Trainer(model.task, REAL, seed=0, transitions=given)
    for ours, theirs in zip(stored(trainer.replay), given, strict=True):
        assert torch.equal(ours, theirs)
    assert trainer.real_steps == 0
    trainer.advance()
    assert trainer.real_steps == 20
    assert trainer.updates == 20  # the given transitions count as the random ones


def test_truncated_data_are_no_terminations() -> None:
    data = replace(MODEL, real_steps=40, steps_per_iteration=40)
    model = ModelTrainer(replace(get_task("pendulum"), max_steps=10), data, seed=0)
    model.advance()
    assert model.data["next", "done"].any()
    assert not model.transitions().terminated.any()


def test_it_learns_to_stop_a_sled() -> None:
    """Far better than doing nothing, than random actions and than where it began."""
    config = RealTD3Config(
        real_steps=1500,
        random_steps=300,
        evaluation_interval=500,
        evaluation_episodes=50,
        actor_hidden_sizes=(32,),
        critic_hidden_sizes=(32, 32),
        critic_learning_rate=1e-3,
        last_layer_scale=0.1,
    )
    trainer = RealTD3Trainer(SLED, config, seed=0)
    untrained = trainer.evaluate().mean()
    while not trainer.done:
        metrics = trainer.advance()
    assert metrics["return_mean"] > 0.25 * untrained
    assert metrics["return_std"] > 0


# Resuming


def test_a_resumed_trainer_goes_on_bit_by_bit() -> None:
    whole = trained(SLED, REAL)
    torch.manual_seed(0)
    first = RealTD3Trainer(SLED, REAL, seed=0)
    first.advance()
    second = RealTD3Trainer(SLED, REAL, seed=5)
    second.load_state_dict(first.state_dict())
    while not second.done:
        second.advance()
    assert torch.equal(second.replay.rows, whole.replay.rows)
    for ours, theirs in zip(second.update.critics, whole.update.critics, strict=True):
        assert torch.equal(ours, theirs)


def test_a_world_without_a_truth_is_refused() -> None:
    task = get_task("pendulum")
    world = SimulatedWorld(task).make_env
    with pytest.raises(ConfigError, match=r"^world\.kind: expected a simulated world"):
        RealTD3Trainer(task, REAL, seed=0, world=world)
