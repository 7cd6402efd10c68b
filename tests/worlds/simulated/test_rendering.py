"""Pictures of the simulated worlds: gymnasium's own, and they follow the state."""

from __future__ import annotations

import math
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.classic_control import AcrobotEnv, CartPoleEnv, PendulumEnv

from phihp_torchrl import get_task
from phihp_torchrl.systems import Acrobot, CartPole, ElbowAcrobot, Pendulum
from phihp_torchrl.worlds import SimulatedWorld, TaskEnv
from phihp_torchrl.worlds.simulated.rendering import env_class

from ..sled import Sled, sled_task

pytest.importorskip("pygame")

one_of_each = pytest.mark.parametrize(
    "env_id", ["phihp/Pendulum-v0", "phihp/CartPoleSwingup-v0", "phihp/AcrobotSwingup-v0"]
)


def picture(env, state):
    env.reset(options={"state": state})
    return env.render()


def centre_row(image, colour):
    """Mean row of the pixels of a colour, from the top."""
    rows = np.nonzero((image == colour).all(-1))[0]
    assert rows.size
    return rows.mean()


@one_of_each
def test_pictures_are_gymnasiums_and_follow_the_state(env_id):
    env = gym.make(env_id, render_mode="rgb_array")
    base = {"P": PendulumEnv, "C": CartPoleEnv, "A": AcrobotEnv}[env_id[6]]
    assert isinstance(env.unwrapped, base)
    # The part that moves: its colour, and where it is with the arm down and up.
    n, angle, down, up, colour = {
        "P": (2, 0, math.pi, 0.0, (204, 77, 77)),
        "C": (4, 2, math.pi, 0.0, (202, 152, 101)),
        "A": (4, 0, 0.0, math.pi, (0, 204, 204)),
    }[env_id[6]]
    image = {}
    for position in (down, up):
        state = np.zeros(n)
        state[angle] = position
        image[position] = picture(env, state)
        assert image[position].dtype == np.uint8
        assert image[position].shape[-1] == 3
    assert centre_row(image[up], colour) < centre_row(image[down], colour) - 50
    # Nothing is cut off: both ways the arm covers as many pixels.
    covered = [(image[p] == colour).all(-1).sum() for p in (up, down)]
    assert covered[0] == pytest.approx(covered[1], rel=0.05)
    env.close()


def test_the_pendulums_arrow_shows_the_applied_torque():
    env = gym.make("phihp/Pendulum-v0", render_mode="rgb_array")
    env.reset(options={"state": [0.0, 0.0]})
    assert env.unwrapped.last_u is None
    env.step(np.array([50.0]))
    assert env.unwrapped.last_u == 2.0
    pushed = env.render()
    env.unwrapped.state = [0.0, 0.0]
    env.step(np.array([-0.5]))
    assert env.unwrapped.last_u == -0.5
    assert not np.array_equal(pushed, env.render())
    env.close()


def test_a_cart_that_ran_far_away_can_still_be_drawn():
    env = gym.make("phihp/CartPoleSwingup-v0", render_mode="rgb_array")
    picture(env, [1e6, 0.0, 0.0, 0.0])
    assert env.unwrapped.state[0] == 1e6
    env.close()


def test_a_task_on_a_known_system_is_drawn():
    moon = replace(get_task("pendulum"), name="moon", system=Pendulum({"gravity": 1.6}))
    env = gym.make("phihp/Task-v0", task=moon, render_mode="rgb_array")
    assert picture(env, [0.0, 0.0]).shape == (500, 500, 3)
    assert env.unwrapped.task is moon
    env.close()


def test_a_world_draws_the_environments_it_makes_for_it():
    world = SimulatedWorld("acrobot")
    env = world.make_env(render=True)
    env.reset()
    first = world.picture(env)
    assert (first.dtype, first.shape[-1]) == (np.uint8, 3)
    for _ in range(3):
        env.step(env.rand_action(env.reset()))
    assert not np.array_equal(first, world.picture(env))
    env.close()


def test_what_can_be_drawn_is_by_the_kind_of_system():
    class MyPendulum(Pendulum):
        pass

    drawn = {Pendulum: PendulumEnv, MyPendulum: PendulumEnv, CartPole: CartPoleEnv}
    for kind, base in {**drawn, Acrobot: AcrobotEnv, ElbowAcrobot: AcrobotEnv}.items():
        assert issubclass(env_class(kind()), base)
        assert issubclass(env_class(kind()), TaskEnv)
    assert env_class(Sled()) is TaskEnv
    with pytest.raises(
        ValueError, match=r"^render_mode: expected one of \[None\], got 'rgb_array'"
    ):
        SimulatedWorld(sled_task()).make_env(render=True)
