"""Phase 2 in units of its own: it learns alike, and what it returns is in physical units."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from phihp_torchrl import Box, HybridDynamics, System, Task
from phihp_torchrl.agents import RefitConfig, TD3Config, act, q_values
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Rollouts
from phihp_torchrl.trainers import PolicyConfig, PolicyTrainer
from phihp_torchrl.worlds import make_world

from .trainer_parts import POLICY, assert_same_state, plain, policy_trainer

REFIT = replace(POLICY, refit=RefitConfig(start=4, interval=4, transitions=32, steps=2))


class Cart(System):
    """A mass that a force moves, in a unit of length of its own."""

    state_names, action_names = ("x", "x_dot"), ("force",)
    velocity_of = {"x": "x_dot"}

    def __init__(self, unit):
        super().__init__()
        self.unit = unit

    def prior(self, state, action, constants):
        x_dot = state[..., 1]
        return torch.stack([x_dot, self.unit * action[..., 0] - 0.1 * x_dot], -1)


def cart(unit, reward=1.0):
    def cost(state, action, next_state):
        return -reward * (next_state / unit).square().sum(-1)

    return Task(
        name="cart",
        system=Cart(unit),
        action_high=(1.0,),
        time_step=0.1,
        max_steps=50,
        reset=Box.around((0.0, 0.0), (0.5 * unit, 0.2 * unit)),
        reward=cost,
        coverage=Box.around((0.0, 0.0), (unit, unit)),
    )


def trainer_in(task, config=REFIT, seed=0, **options):
    torch.manual_seed(seed)
    return PolicyTrainer(task, HybridDynamics.pure_prior(task), config, seed=seed, **options)


def test_actor_critics_and_metrics_are_in_physical_units():
    task = cart(4000.0, 1e5)
    trainer = trainer_in(task, world=make_world(task))
    metrics = [trainer.advance() for _ in range(3)][-1]
    assert trainer.scales.scale.tolist() == [4096, 4096]
    assert trainer.scales.reward > 1000
    actor = [p.detach() for p in trainer.best_actor().module.mlp.parameters()]
    model = TaskWorldModel(task, HybridDynamics.pure_prior(task))
    rollouts = Rollouts(model, act, max_age=5)
    physical = rollouts.returns(actor, trainer.evaluation.states, steps=5).total.mean().item()
    assert physical == pytest.approx(trainer.best_return, rel=1e-4)
    actor = [p.detach() for p in trainer.actor().module.mlp.parameters()]
    played = rollouts.returns(actor, trainer.evaluation.world_states, steps=5).total.mean().item()
    assert metrics["policy/real_return"] == pytest.approx(played, rel=1e-3)
    # The critics value a state as the refit's targets do: by rewards of this size.
    state = task.coverage.sample([64])
    critics = [p.detach() for p in trainer.best_qvalue().module.layers]
    values = q_values(critics, model.observe(state), torch.zeros(64, 1), task.bounds)
    ours = trainer.best[len(trainer.update.actor) :]
    unit = q_values(ours, trainer.world_model.observe(state), torch.zeros(64, 1), task.bounds)
    torch.testing.assert_close(values, trainer.scales.reward * unit, rtol=1e-3, atol=1.0)


def test_units_that_are_powers_of_two_train_to_the_bit():
    reference, large = (trainer_in(cart(unit)) for unit in (1.0, 4096.0))
    while not reference.done:
        one, other = reference.advance(), large.advance()
        for name in one:
            if not name.endswith("seconds"):
                assert one[name] == pytest.approx(other[name], rel=1e-4, abs=1e-6), name
    for mine, theirs in zip(reference.best, large.best, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)


def test_none_trains_in_physical_units():
    trainer = trainer_in(cart(4000.0), replace(REFIT, scales="none"))
    assert trainer.scales.are_one
    with pytest.raises(ConfigError, match=r"scales: expected one of \['auto', 'none'\]"):
        PolicyConfig(scales="some")


def test_a_run_in_units_of_its_own_resumes_to_the_bit():
    first = trainer_in(cart(4000.0))
    first.advance()
    saved = first.state_dict()
    plain(saved)
    again = trainer_in(cart(4000.0))
    again.load_state_dict(saved)
    first.advance()
    again.advance()
    assert_same_state(first.state_dict(), again.state_dict(), but=("seconds",))


def test_a_checkpoint_in_other_units_is_refused():
    old = trainer_in(cart(4000.0), replace(REFIT, scales="none")).state_dict()
    trainer = trainer_in(cart(4000.0))
    with pytest.raises(ConfigError, match=r"policy.scales: .* policy.scales=none"):
        trainer.load_state_dict(old)
    del old["scales"]  # as before there were units
    with pytest.raises(ConfigError, match=r"policy\.scales"):
        trainer.load_state_dict(old)


def test_a_checkpoint_from_before_there_were_units_resumes():
    saved = policy_trainer().state_dict()
    del saved["scales"]
    policy_trainer().load_state_dict(saved)


@pytest.mark.slow
def test_it_learns_in_any_units():
    def learn(unit, reward, scales):
        widths = {"actor_hidden_sizes": (32, 32), "critic_hidden_sizes": (32, 32)}
        config = PolicyConfig(
            updates=400,
            evaluation_interval=400,
            real_evaluation_episodes=0,
            scales=scales,
            td3=TD3Config(**widths),
            refit=RefitConfig(interval=0),
        )
        trainer = trainer_in(cart(unit, reward), config)
        while not trainer.done:
            trainer.advance()
        return trainer.best_return / reward

    assert learn(3000.0, 1 / 3000, "auto") > -20
    assert learn(1 / 3000, 3000.0, "auto") > -20
    assert learn(3000.0, 1.0, "none") < -100, "which is why there are units"


def test_rollouts_in_units_are_the_same_prepared():
    task = cart(4000.0, 1e5)
    trainer = trainer_in(task)
    model = trainer.world_model
    assert type(model.prepared()) is not type(model)
    state = task.coverage.sample([5])
    action = torch.zeros(5, 1)
    with torch.no_grad():
        found = model.prepared().transition(state, action)
        for one, other in zip(found, model.transition(state, action), strict=True):
            torch.testing.assert_close(one, other)
        seen = model.observe(state)
        torch.testing.assert_close(model.prepared().observe(state), seen)
        command, following = model.prepared().advance(state, action)
        reward, _ = model.prepared().judge(state, command, following)
        torch.testing.assert_close(reward, found.reward)
        torch.testing.assert_close(model.prepared().locate(seen), state)

    class Otherwise(type(model)):
        def observe(self, state):
            return 2 * super().observe(state)

    model.__class__ = Otherwise
    assert model.prepared() is model
