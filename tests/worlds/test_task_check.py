"""A dry check of system, task and world: what does not fit is named before any real step."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torchrl.envs import EnvBase, StepCounter, Transform, TransformedEnv

from phihp_torchrl import ConfigError, get_task
from phihp_torchrl.systems import Pendulum, System
from phihp_torchrl.tasks import Task, list_tasks
from phihp_torchrl.trainers import ModelConfig, RunConfig, run
from phihp_torchrl.worlds import EnvWorld, SimulatedWorld, World, check_task

PENDULUM = get_task("pendulum")


@pytest.mark.parametrize("name", [name for name in list_tasks() if "-" not in name])
def test_the_tasks_of_the_package_pass(name: str) -> None:
    check_task(name, "simulated")


# A system


class Wide(Pendulum):
    def prior(self, state, action, constants):
        return torch.cat([super().prior(state, action, constants), action], -1)


class Pair(Pendulum):
    def prior(self, state, action, constants):
        return tuple(super().prior(state, action, constants).unbind(-1))


class OneState(Pendulum):
    def prior(self, state, action, constants):
        theta, velocity = state  # as if there were no batch
        return torch.stack([velocity, theta.sin() + action[0]])


class Mixed(Pendulum):
    def prior(self, state, action, constants):
        return super().prior(state, action, constants) - state.mean()


class Singular(Pendulum):
    def prior(self, state, action, constants):
        return super().prior(state, action, constants) / torch.zeros_like(state)


class Blind(Pendulum):
    def locate(self, observation):
        return super().locate(observation) * 0.5


class Worn(Pendulum):
    def prior(self, state, action, constants):
        return super().prior(state, action.mul_(0.5), constants)


class Wrapped(Pendulum):
    def observe(self, state):
        state[..., 0].remainder_(0.1)
        return super().observe(state)


class NoConstants(Pendulum):
    def __init__(self, length):
        self.length = length


class Long(Pendulum):
    """A system whose constructor needs an argument, which is its own affair."""

    def __init__(self, length):
        super().__init__()
        self.length = length


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (Wide(), "Wide.prior: expected float32 of shape [6, 2] for tensors of shape [6, 2], [6,"),
        (Pair(), "Pair.prior: expected float32 of shape [6, 2]"),
        (OneState(), "OneState.prior: it failed for tensors of shape [6, 2], [6, 1]: ValueError"),
        (Mixed(), "Mixed.prior: expected the same for a state alone as in a batch, got"),
        (Singular(), "Singular.prior: expected finite numbers, got"),
        (
            Worn(),
            "Worn.prior: expected it to leave what it is given as it is, it changed argument 2",
        ),
        (Wrapped(), "Wrapped.observe: expected it to leave what it is given as it is, it changed"),
        (Blind(), "Blind.locate: expected the state that Blind.observe shows"),
        (NoConstants(2.0), "system: expected NoConstants.__init__ to call super().__init__("),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, System) else "",
)
def test_a_system_that_does_not_fit_is_named(system: System, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        check_task(replace(PENDULUM, system=system))


def test_a_systems_constructor_may_need_an_argument() -> None:
    check_task(replace(PENDULUM, system=Long(2.0)), "simulated")


# Functions of a task


def column(state, action, next_state):
    return next_state[..., :1]


def number(state, action, next_state):
    return 1.0


def count(state, action, next_state):
    return torch.ones(state.shape[:-1], dtype=torch.int64)


def upright(state, action, next_state):
    return next_state[..., 0].abs() < 0.1


def double(state, action, next_state):
    return next_state[..., 0].double()


def summed(state, action, next_state):
    return next_state.sum()


def keyed(state, action, next_state):
    return next_state.theta


def elsewhere(state, action, next_state):
    return torch.zeros(state.shape[:-1], device="meta")


def spent(state, action, next_state):
    return next_state.abs_().sum(-1)


def clamped(next_state):
    return next_state.clamp_(-0.1, 0.1)[..., 0] > 0.05


def fallen(next_state):
    return (next_state[..., 0].abs() > 1.0).float()


def any_fallen(next_state):
    return (next_state[..., 0].abs() > 1.0).any().expand(next_state.shape[:-1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reward": column}, "reward, column: expected float32 of shape [6] for tensors of shape"),
        ({"reward": number}, "reward, number: expected float32 of shape [6]"),
        ({"reward": count}, "reward, count: expected float32 of shape [6]"),
        ({"reward": upright}, "reward, upright: expected float32 of shape [6]"),
        ({"reward": double}, "reward, double: expected float32 of shape [6]"),
        ({"reward": summed}, "reward, summed: expected float32 of shape [6]"),
        ({"reward": keyed}, "reward, keyed: it failed for tensors of shape [6, 2], [6, 1], [6, 2]"),
        ({"exploration_reward": column}, "exploration_reward, column: expected float32 of shape"),
        ({"reward": elsewhere}, "reward, elsewhere: expected a tensor on cpu, got one on meta"),
        ({"reward": spent}, "reward, spent: expected it to leave what it is given as it is"),
        ({"terminated": clamped}, "terminated, clamped: expected it to leave what it is given"),
        ({"terminated": fallen}, "terminated, fallen: expected bool of shape [6]"),
        ({"terminated": any_fallen}, "terminated, any_fallen: expected the same for a state alone"),
    ],
    ids=lambda value: next(iter(value.values())).__name__ if isinstance(value, dict) else "",
)
def test_a_function_of_a_task_that_does_not_fit_is_named(change: dict, message: str) -> None:
    wide = replace(PENDULUM.reset, low=(-2.0, -1.0), high=(2.0, 1.0))
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        check_task(replace(PENDULUM, reset=wide, **change))


# Environments


class Changed(Transform):
    """Changes an environment's keys as ``change`` says, and not its specs."""

    def __init__(self, change: Callable[[Any], Any]) -> None:
        super().__init__()
        self.change = change

    def _reset(self, tensordict, tensordict_reset):
        return self.change(tensordict_reset)


class Rig(World):
    """A world of one's own, which does not go through the checks of :class:`EnvWorld`."""

    kind = "rig"

    def __init__(self, task: Task, make: Callable[[], Any]) -> None:
        super().__init__(task)
        self.make = make

    def make_env(self, *, render: bool = False) -> EnvBase:
        return self.make()


def cartpole() -> EnvBase:
    return SimulatedWorld("cartpole").make_env()


def changed(change: Callable[[Any], Any]) -> Callable[[], EnvBase]:
    return lambda: TransformedEnv(SimulatedWorld("pendulum").make_env(), Changed(change))


def without_count() -> EnvBase:
    return SimulatedWorld("pendulum").make_env().base_env


def broken() -> EnvBase:
    def fail(td):
        raise OSError("no such port")

    return changed(fail)()


def twice(td):
    return td.set("observation", torch.cat([td["observation"]] * 2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (cartpole, "world: expected 'observation' of shape [3] (cos theta, sin theta, theta_dot)"),
        (lambda: "env", "world: expected a TorchRL environment, got str"),
        (without_count, "world: expected a reset to return a 'step_count' of one number, got none"),
        (broken, "world: its environment cannot be reset: OSError: no such port"),
        (changed(twice), "world: expected a reset to return an 'observation' of its spec's shape"),
    ],
    ids=["another", "none", "no-count", "broken", "wider"],
)
def test_an_environment_that_does_not_fit_is_named(make: Callable, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        check_task(PENDULUM, Rig(PENDULUM, make))


def test_an_environment_with_an_action_too_many_is_named() -> None:
    two = get_task("acrobot")
    with pytest.raises(ConfigError, match=r"expected (a continuous 'action'|'observation')"):
        check_task(PENDULUM, EnvWorld(PENDULUM, SimulatedWorld(two).make_env))


def test_a_world_of_ones_own_that_fits_passes() -> None:
    make = lambda: TransformedEnv(without_count(), StepCounter(max_steps=20))  # noqa: E731
    check_task(PENDULUM, Rig(PENDULUM, make))


# A run


class Counted(Transform):
    steps = 0

    def _step(self, tensordict, next_tensordict):
        type(self).steps += 1
        return next_tensordict


@pytest.mark.parametrize(
    "change",
    [{"reward": column}, {"terminated": fallen}, {"system": Wide()}, {"exploration_reward": count}],
    ids=["reward", "terminated", "prior", "exploration_reward"],
)
def test_a_run_makes_the_check_before_any_real_step(tmp_path, change: dict) -> None:
    task = replace(PENDULUM, **change)
    Counted.steps = 0
    make = lambda: TransformedEnv(SimulatedWorld(PENDULUM).make_env(), Counted())  # noqa: E731
    world = EnvWorld(task, make)
    config = RunConfig("pendulum", phases=("model",), sections={"model": ModelConfig()})
    with pytest.raises(ConfigError, match=r"reward|terminated|prior"):
        run(config, tmp_path / "run", world=world)
    assert Counted.steps == 0
    assert not (tmp_path / "run").exists()


def test_a_run_names_an_environment_without_a_count(tmp_path) -> None:
    config = RunConfig("pendulum", phases=("model",), sections={"model": ModelConfig()})
    with pytest.raises(ConfigError, match="StepCounter"):
        run(config, tmp_path / "run", world=Rig(PENDULUM, without_count))
