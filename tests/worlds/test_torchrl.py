"""Worlds behind any TorchRL environment: what is asked of it, and what is said where it is not."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import ActionScaling, EnvBase, StepCounter, TransformedEnv, check_env_specs

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.worlds import EnvWorld, SimulatedWorld, TorchRLConfig, import_object

PENDULUM = get_task("pendulum")
LANGUAGE = "'observation' of shape [3] (cos theta, sin theta, theta_dot)"


class Still(EnvBase):
    """A pendulum that stands still, with specs of any sort."""

    def __init__(self, *, observation=None, action=None, reward=None, batch=(), key="observation"):
        super().__init__(batch_size=torch.Size(batch))
        batch = tuple(batch)
        observation = Unbounded((*batch, 3)) if observation is None else observation
        self.observation_spec = Composite({key: observation}, shape=batch)
        self.action_spec = Bounded(-2.0, 2.0, (*batch, 1)) if action is None else action
        self.reward_spec = Unbounded((*batch, 1)) if reward is None else reward
        self.done_spec = Binary(1, shape=(*batch, 1), dtype=torch.bool)

    def _reset(self, tensordict=None, **_):
        return self.full_observation_spec.zero().update(self.full_done_spec.zero())

    def _step(self, tensordict):
        return self._reset().update(self.full_reward_spec.zero())

    def _set_seed(self, seed):
        pass


def refused(env, task=PENDULUM):
    with pytest.raises(ConfigError) as caught:
        EnvWorld(task, env).make_env()
    return caught.value


# What is taken


def test_an_environment_is_taken_as_it_is_and_a_function_is_called_anew():
    env = TransformedEnv(Still(), StepCounter(5))
    assert EnvWorld(PENDULUM, env).make_env() is env
    made = []

    def make():
        made.append(Still())
        return made[-1]

    world = EnvWorld(PENDULUM, make)
    assert not made
    assert world.make_env().base_env is made[0]
    assert world.make_env(render=True).base_env is made[1]


def test_steps_are_counted_and_limited_where_they_are_not():
    data = EnvWorld(replace(PENDULUM, max_steps=4), Still()).make_env().rollout(100)
    assert data["next", "step_count"].flatten().tolist() == [1, 2, 3, 4]
    assert data["next", "truncated"].flatten().tolist() == [False] * 3 + [True]
    own = TransformedEnv(Still(), StepCounter(3))
    assert EnvWorld(PENDULUM, own).make_env().rollout(100).shape == (3,)


def test_doubles_become_floats():
    double = torch.float64
    env = Still(
        observation=Unbounded((3,), dtype=double), reward=Unbounded((1,), dtype=torch.float64)
    )
    data = EnvWorld(PENDULUM, env).make_env().rollout(3)
    assert data["observation"].dtype == data["next", "observation"].dtype == torch.float32
    assert data["next", "reward"].dtype == torch.float32


def test_an_action_without_bounds_is_any():
    env = Still(action=Unbounded((1,)))
    assert EnvWorld(PENDULUM, env).make_env().rollout(2).shape == (2,)


def test_it_has_no_truth_and_no_picture():
    world = EnvWorld(PENDULUM, Still(), label="a robot")
    assert (world.truth, world.model()) == (None, None)
    assert world.picture(world.make_env(render=True)) is None
    assert (world.kind, str(world)) == ("torchrl", "a robot")


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot-swingup"])
def test_a_simulated_world_may_be_seen_through_its_transitions_alone(name):
    task = get_task(name)
    seen, own = EnvWorld(task, SimulatedWorld(task).make_env), SimulatedWorld(task)
    rollouts = []
    for world in (seen, own):
        env = world.make_env()
        env.set_seed(3)
        torch.manual_seed(0)
        rollouts.append(env.rollout(10))
    for key in ("observation", "action", ("next", "reward"), ("next", "step_count")):
        assert torch.equal(rollouts[0][key], rollouts[1][key])


# What is not, in which words


@pytest.mark.parametrize(
    ("env", "reason"),
    [
        (
            lambda: Still(observation=Unbounded((2,))),
            f"expected {LANGUAGE}, got torch.float32 of shape [2].",
        ),
        (
            lambda: Still(observation=Unbounded((3, 1))),
            f"expected {LANGUAGE}, got torch.float32 of shape [3, 1].",
        ),
        (
            lambda: Still(observation=Unbounded((3,), dtype=torch.uint8)),
            f"expected {LANGUAGE}, got torch.uint8 of shape [3].",
        ),
        (lambda: Still(key="pixels"), f"expected {LANGUAGE}, it has ['pixels']."),
        (
            lambda: Still(action=Bounded(-2.0, 2.0, (2,))),
            "expected a continuous 'action' of shape [1] (torque), got torch.float32 of shape [2].",
        ),
        (
            lambda: Still(action=Categorical(3)),
            "expected a continuous 'action' of shape [1] (torque), got torch.int64 of shape [].",
        ),
        (
            lambda: Still(action=Composite(push=Bounded(-2.0, 2.0, (1,)))),
            "expected a continuous 'action' of shape [1] (torque), it has ['push'].",
        ),
        (
            lambda: Still(reward=Composite(gain=Unbounded((1,)))),
            "expected a 'reward' of one number, got none.",
        ),
        (
            lambda: Still(reward=Unbounded((2,))),
            "expected a 'reward' of one number, got shape [2].",
        ),
        (lambda: Still(batch=[4]), "expected batch size [], got [4]."),
    ],
)
def test_an_environment_of_another_world_is_refused(env, reason):
    for given in (env, env()):
        error = refused(given)
        assert (error.key, error.reason) == ("world", reason)


def test_a_task_that_wants_more_than_the_world_gives_is_refused():
    lopsided = Still(action=Bounded(torch.tensor([-1.0]), torch.tensor([5.0])))
    task = replace(PENDULUM, name="mine", action_low=(-2.0,), action_high=(4.0,))
    error = refused(lopsided, task)
    assert error.key == "action_high"
    assert error.reason == (
        "expected bounds of torque within the world's, -1 to 5; the task 'mine' has -2 to 4."
    )
    within = replace(task, action_low=(-1.0,))
    assert EnvWorld(within, lopsided).make_env().rollout(2).shape == (2,)


@pytest.mark.parametrize(("low", "high"), [((-6.0,), (12.0,)), ((0.0,), (100.0,))])
def test_asymmetric_bounds_of_a_world_are_those_of_the_task(low, high):
    task = replace(PENDULUM, action_low=low, action_high=high)
    env = EnvWorld(task, SimulatedWorld(task).make_env).make_env()
    assert (env.action_spec.space.low, env.action_spec.space.high) == (low[0], high[0])
    actions = env.rollout(100)["action"]
    assert ((actions >= low[0]) & (actions <= high[0])).all()


def test_what_is_no_environment_is_named():
    error = refused(lambda: TensorDict())
    assert (error.key, error.reason) == (
        "world.make",
        "expected a TorchRL or gymnasium environment, got TensorDict.",
    )


# By name


def test_a_function_is_found_by_its_name(tmp_path, monkeypatch):
    (tmp_path / "my_robot_world.py").write_text(
        "from phihp_torchrl.worlds import SimulatedWorld\n"
        "def make(task='pendulum'):\n"
        "    return SimulatedWorld(task).make_env()\n"
        "name = 'no function'\n"
    )
    monkeypatch.chdir(tmp_path)
    world = EnvWorld.from_config(PENDULUM, TorchRLConfig("my_robot_world:make"))
    assert str(world) == "torchrl my_robot_world:make"
    assert world.make_env().rollout(2)["observation"].shape == (2, 3)
    other = TorchRLConfig("my_robot_world:make", {"task": "acrobot"})
    acrobot = EnvWorld.from_config(get_task("acrobot"), other)
    assert acrobot.make_env().rollout(2)["observation"].shape == (2, 6)
    assert import_object("x", "my_robot_world:name") == "no function"


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (
            "no_such_module_anywhere:make",
            "no_such_module_anywhere:make cannot be imported: ModuleNotFoundError: "
            "No module named 'no_such_module_anywhere'",
        ),
        (
            "math:no_such_function",
            "math:no_such_function cannot be imported: AttributeError: "
            "module 'math' has no attribute 'no_such_function'",
        ),
    ],
)
def test_what_cannot_be_imported_is_named(name, reason):
    with pytest.raises(ConfigError) as caught:
        EnvWorld.from_config(PENDULUM, TorchRLConfig(name))
    assert (caught.value.key, caught.value.reason) == ("world.make", reason)


def test_a_module_that_fails_says_why(tmp_path, monkeypatch):
    (tmp_path / "broken_robot_world.py").write_text("raise RuntimeError('no robot attached')\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"^world\.make: .*RuntimeError: no robot attached"):
        EnvWorld.from_config(PENDULUM, TorchRLConfig("broken_robot_world:make"))


@pytest.mark.parametrize("name", ["", "make", ":make", "module:"])
def test_a_name_has_a_module_and_a_function(name):
    with pytest.raises(ConfigError, match=r"^make: expected module:function, got "):
        TorchRLConfig(name)


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "acrobot-swingup"])
def test_specs_of_worlds_without_limits_give_numbers(name):
    """gymnasium says infinite limits, of which TorchRL samples NaN."""
    for world in (SimulatedWorld(name), EnvWorld(get_task(name), SimulatedWorld(name).make_env)):
        env = world.make_env()
        for _ in range(5):
            for spec in (env.observation_spec, env.full_action_spec, env.full_reward_spec):
                values = spec.rand().values(True, True)
                assert all(value.isfinite().all() for value in values)
        check_env_specs(env)


@pytest.mark.parametrize("extra", [{}, {"action_rate_limit": 3.0}, {"actuator": Actuator(2.0)}])
def test_actions_stay_in_the_spec_of_a_scaled_world(extra):
    task = replace(get_task("pendulum"), **extra)
    world = SimulatedWorld(task)
    for env in (world.make_env(), world.make_batch([3], seed=0)):
        scaled = TransformedEnv(env, ActionScaling())
        actions = scaled.rollout(30)["action"]
        assert actions.abs().max() <= 1.0
        assert actions.abs().max() > 0.5
    with pytest.raises(ConfigError, match=r"expected bounds of torque within the world's, -1 to 1"):
        EnvWorld(task, lambda: TransformedEnv(world.make_env(), ActionScaling())).make_env()
