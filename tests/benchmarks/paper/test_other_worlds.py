"""Worlds of others are shown in the words of their tasks, and their stops are the term's."""

from __future__ import annotations

import importlib.util

import pytest
import torch
from tensordict import TensorDict

from other_worlds import STEPS, WORLDS, shares
from phihp_torchrl import HybridDynamics
from phihp_torchrl.dynamics import DynamicsLoss
from phihp_torchrl.trainers import ModelConfig
from phihp_torchrl.worlds import make_world

HAS_DM_CONTROL = importlib.util.find_spec("dm_control") is not None
needs_dm_control = pytest.mark.skipif(
    not HAS_DM_CONTROL, reason="dm_control is not installed (the extra 'dmcontrol')"
)
TRUTH = {
    "dm_control cartpole": {
        "cart_mass": 1.0,
        "pole_mass": 0.1,
        "half_length": 0.516,
        "stiffness": 164.0,
        "damping": 26.3,
        "share": 0.95,
    },
    "dm_control pendulum": {"mass": 1.0, "length": 0.5},
    "dm_control acrobot": {
        "mass1": 1.0,
        "mass2": 1.0,
        "center1": 0.5,
        "center2": 0.5,
        "inertia1": 0.09,
        "inertia2": 0.09,
    },
    "gymnasium MountainCarContinuous-v0": {"motor": 0.15, "slope": 0.25},
    "gymnasium MountainCarContinuous-v0 as it is": {"motor": 0.0015, "slope": 0.0025},
    "gymnasium Pendulum-v1": {"mass": 1.0, "length": 1.0},
}
CASES = [
    pytest.param(name, marks=[needs_dm_control] if name.startswith("dm_control") else [])
    for name in TRUTH
]
OF_THE_CARTPOLE = [name for name in WORLDS if name.startswith("dm_control cartpole")]


@pytest.mark.parametrize("name", WORLDS)
def test_what_is_told_of_the_simulator_is_what_a_fit_takes(name):
    ModelConfig(**WORLDS[name].model)


def played(world, policy, steps, seed=100):
    env = make_world(world.task, world.make_env).make_env()
    env.set_seed(seed)
    with torch.no_grad():
        return env.rollout(steps, policy, break_when_any_done=False)


def pushed(world):
    """A policy of random actions, and then of one full push, so that carts reach a stop."""
    draws, count = torch.Generator().manual_seed(0), 0
    bounds = world.task.bounds

    def policy(td: TensorDict) -> TensorDict:
        nonlocal count
        count += 1
        unit = 2 * torch.rand(1, generator=draws) - 1 if count < 60 else torch.ones(1)
        return td.set("action", bounds.from_unit(unit))

    return policy


def known(world, constants):
    integrator = {"integrator": world.model.get("integrator", "semi_implicit_euler")}
    model = HybridDynamics.pure_prior(world.task, constants=constants, **integrator)
    model.integrator.substeps = world.model.get("substeps", 1)
    return DynamicsLoss(model)


@pytest.mark.parametrize("name", CASES)
def test_the_textbook_with_true_constants_predicts_and_the_guesses_do_not(name):
    world = WORLDS[name]
    data = played(world, pushed(world), 160)
    found = shares(known(world, TRUTH[name]), data, world.stops)["1"]
    guessed = shares(known(world, {}), data, world.stops)["1"]
    assert found["overall"]["all"] < 0.1, "friction, and a rod that is no line, are left out"
    assert guessed["overall"]["all"] > 2 * found["overall"]["all"]
    if name == "dm_control cartpole":  # it has met its stop
        assert found["away"]["windows"] < found["overall"]["windows"]


@needs_dm_control
@pytest.mark.parametrize("name", OF_THE_CARTPOLE)
def test_the_cartpoles_differ_in_start_and_reward_alone(name):
    world = WORLDS[name]
    task = world.task
    data = played(world, pushed(world), 40)
    state, after = task.locate(data["observation"]), task.locate(data["next", "observation"])
    assert (state[0, 2].abs() > 3.0) == ("balance" not in name)
    told = task.reward(state, data["action"], after)
    found = data["next", "reward"].squeeze(-1)
    if "sparse" in name:  # a reward is met or left between two steps of the simulator
        assert (told != found).sum() <= 1
        assert set(told.unique().tolist()) <= {0.0, 2.0}
        assert (found.sum() > 0) == ("balance" in name)
    else:
        torch.testing.assert_close(told, found, atol=0.05, rtol=0.0)


@needs_dm_control
def test_episodes_of_dm_control_differ_by_their_seed():
    world = WORLDS["dm_control pendulum"]
    first, same, other = (
        played(world, pushed(world), 3, seed)["observation"] for seed in (100, 100, 101)
    )
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("steps", STEPS)
def test_shares_are_one_for_a_model_in_which_nothing_changes(steps):
    world = WORLDS["gymnasium MountainCarContinuous-v0"]
    loss = known(world, {})
    loss.dynamics.step = lambda state, *_: state
    data = played(world, pushed(world), 100)
    for row in shares(loss, data, world.stops)[str(steps)].values():
        del row["windows"]
        assert list(row.values()) == pytest.approx([1.0] * 3)
