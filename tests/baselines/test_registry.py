"""Which baselines a task has, and one of a user's own."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from phihp_torchrl import ConfigError, HybridDynamics, get_task
from phihp_torchrl.baselines import BASELINES, make_baselines, register_baseline
from phihp_torchrl.tasks import Actuator, Disturbance, Signal, Task

EXPECTED = {
    "pendulum": {"lqr", "pid", "energy"},
    "cartpole": {"lqr", "pid"},
    "acrobot": {"energy"},
}


@pytest.mark.parametrize("name", EXPECTED)
def test_the_quick_ones_that_apply(name: str) -> None:
    task = get_task(name)
    found = make_baselines(task, HybridDynamics.pure_prior(task))
    assert found.keys() == EXPECTED[name]
    observation = task.observe(task.reset.sample([2, 3]))
    for controller in found.values():
        action = controller(TensorDict(observation=observation, batch_size=[2, 3]))["action"]
        assert action.shape == (2, 3, task.action_dim)
        torch.testing.assert_close(action, task.clip_action(action))


def following(state, action, next_state, reference):
    return -(state[..., 0] - reference[..., 0]).square()


EXTRAS = {
    "price": ({"action_rate_cost": 0.1}, {"lqr", "pid", "energy"}),
    "rate": ({"action_rate_limit": 10.0, "actuator": Actuator(delay_steps=1.0)},
             {"lqr", "pid", "energy"}),
    "disturbance": ({"disturbance": Disturbance({"theta_dot": 1.0})}, {"lqr", "pid", "energy"}),
    "reference": ({"reference": Signal(("theta",), (-1.0,), (1.0,)), "reward": following},
                  {"lqr", "pid", "energy"}),
}  # fmt: skip


@pytest.mark.parametrize("extra", EXTRAS)
def test_those_of_a_task_with_more_in_its_state(extra: str) -> None:
    options, expected = EXTRAS[extra]
    task: Task = replace(get_task("pendulum"), **options)
    found = make_baselines(task, HybridDynamics.pure_prior(task))
    assert found.keys() == expected
    observation = task.observe(task.sample_start([2]))
    for controller in found.values():
        action = controller(TensorDict(observation=observation, batch_size=[2]))["action"]
        assert action.shape == (2, 1)


def test_named_ones_only() -> None:
    task = get_task("pendulum")
    dynamics = HybridDynamics.pure_prior(task)
    assert list(make_baselines(task, dynamics, "none")) == []
    found = make_baselines(task, dynamics, ["mppi"])
    data = TensorDict(observation=task.observe(torch.zeros(2, 2)), batch_size=[2])
    assert found["mppi"](data)["action"].shape == (2, 1)


def test_a_name_that_is_none_and_one_that_does_not_apply() -> None:
    task = get_task("acrobot")
    dynamics = HybridDynamics.pure_prior(task)
    with pytest.raises(ConfigError, match=r"baselines: expected auto, none, or a list .*got 'lqg'"):
        make_baselines(task, dynamics, ["lqg"])
    with pytest.raises(ConfigError, match="baselines: 'lqr' does not apply: goal"):
        make_baselines(task, dynamics, ["lqr"])
    task = get_task("cartpole")
    with pytest.raises(ConfigError, match="baselines: 'energy' does not apply: task: 'cartpole'"):
        make_baselines(task, HybridDynamics.pure_prior(task), ["energy"])


def test_one_of_ones_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BASELINES, "_entries", dict(BASELINES))
    act = TensorDictModule(lambda obs: obs[..., :1] * 0, ["observation"], ["action"])
    register_baseline("idle", lambda task, dynamics: act, applies=lambda t: t.name == "pendulum")
    with pytest.raises(ConfigError, match="baselines: 'idle' is registered already"):
        register_baseline("idle", lambda task, dynamics: act)
    for name, there in (("pendulum", True), ("acrobot", False)):
        task = get_task(name)
        assert ("idle" in make_baselines(task, HybridDynamics.pure_prior(task))) is there
