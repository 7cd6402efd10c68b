"""Eager plans take fewer operations than the functions of the model, and find the same."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode

from phihp_torchrl import HybridDynamics, Task, WorldModelEnv, get_task, load_config
from phihp_torchrl.agents import make_actor, make_twin_qvalue
from phihp_torchrl.config import read_kind, resolve_seconds
from phihp_torchrl.dynamics import PreparedModel, TaskWorldModel
from phihp_torchrl.planners import PLANNERS, CEMConfig, CEMPlanner, colored
from phihp_torchrl.systems import System

TASKS = ["pendulum", "cartpole", "cartpole-swingup", "acrobot", "acrobot-swingup"]
SMALL = CEMConfig(
    planning_horizon=4, num_candidates=24, top_k=5, num_policy_candidates=6, num_kept_elites=2
)


def make(task, dynamics=None, settings=SMALL, value_weight=1.0):
    torch.manual_seed(0)
    task = get_task(task) if isinstance(task, str) else task
    dynamics = HybridDynamics.hybrid(task) if dynamics is None else dynamics(task)
    qvalue = make_twin_qvalue(task, (8, 8)) if value_weight else None
    env = WorldModelEnv(TaskWorldModel(task, dynamics), seed=0)
    actor = make_actor(task, (8, 8))
    return CEMPlanner.from_config(env, settings, actor=actor, qvalue=qvalue)


def both(planner, batch=(3,), seed=1, last=None):
    """The plan by the model's functions, and that of the planner, from the same noise."""
    generator = torch.Generator().manual_seed(seed)
    task, s = planner.env.tensor_model.task, planner.settings
    state = task.at_rest((task.coverage or task.reset).sample(list(batch), generator=generator))
    observation = task.observe(state)
    noise = torch.randn(s.noise_shape(batch, task.action_dim), generator=generator)
    mean = 0.1 * torch.randn(*batch, s.planning_horizon, task.action_dim, generator=generator)
    with torch.no_grad():
        same = colored(noise, s.noise_beta, dim=1)
        plain = planner._plan(observation, same, mean, last, problem=planner.problem(), settings=s)
    data = TensorDict(observation=observation, batch_size=batch)
    return plain, planner.plan(data, noise, mean, last)


class Operations(TorchDispatchMode):
    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        self.count += 1
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_they_find_the_same_plan(name, batch):
    torch.testing.assert_close(*both(make(name), batch), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_they_find_the_same_plan_by_each_preset(preset):
    settings = read_kind(PLANNERS, load_config("acrobot", preset=preset)["planner"], "planner")
    settings = resolve_seconds(settings, get_task("acrobot").time_step)
    torch.testing.assert_close(*both(make("acrobot", settings=settings)), atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(
    "dynamics",
    [
        partial(HybridDynamics.hybrid, integrator="rk4"),
        partial(HybridDynamics.hybrid, ensemble=3, residual_outputs="all"),
        partial(HybridDynamics.hybrid, activation=torch.nn.SiLU),
        HybridDynamics.data_driven,
        HybridDynamics.pure_prior,
    ],
)
def test_they_find_the_same_plan_in_each_model(dynamics):
    torch.testing.assert_close(*both(make("cartpole-swingup", dynamics)), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    "changes",
    [
        {"action_rate_cost": 0.3},
        {"action_rate_limit": 4.0, "velocity_limits": {"theta_dot": (-1.0, 2.0)}},
        {"position_limits": {"theta": (-1.0, 1.0)}, "restitution": 0.5},
        {"terminated": lambda next_state: next_state[..., 1].abs() > 3.0},
    ],
)
def test_they_find_the_same_plan_with_what_a_task_adds(changes):
    planner = make(replace(get_task("pendulum"), **changes))
    torch.testing.assert_close(*both(planner), atol=1e-4, rtol=1e-4)


def test_they_find_the_same_plan_at_a_price_of_change():
    planner = make("pendulum", settings=replace(SMALL, change_cost=0.5))
    last = torch.tensor([[1.0], [torch.nan], [-2.0]])
    plain, found = both(planner, last=last)
    torch.testing.assert_close(plain, found, atol=1e-4, rtol=1e-4)
    free = planner._plan
    assert free is not None
    assert not torch.allclose(found.score, both(planner, last=-last)[1].score)


def test_weights_that_change_in_place_take_effect():
    planner = make("pendulum")
    first = both(planner)[1]
    with torch.no_grad():
        for parameter in planner.parameters():
            parameter.add_(0.05)
    plain, found = both(planner)
    torch.testing.assert_close(plain, found, atol=1e-4, rtol=1e-4)
    assert not torch.allclose(first.score, found.score)


def test_hooks_of_networks_are_called():
    planner = make("pendulum")
    calls = []
    planner.actor.module.mlp[0].register_forward_hook(lambda *_: calls.append(0))
    both(planner)
    count = len(calls)
    both(planner)
    assert count > 0
    assert len(calls) == 2 * count


@pytest.mark.parametrize("name", TASKS)
def test_they_take_fewer_operations(name):
    planner = make(name)
    plain, found = Operations(), Operations()
    task = planner.env.tensor_model.task
    observation = task.observe(task.reset.sample([]))
    noise = torch.randn(planner.settings.noise_shape((), task.action_dim))
    with torch.no_grad():
        for count, prepared in ((plain, False), (found, True)):
            with count:
                problem = planner.problem(prepared=prepared)
                planner._plan(observation, noise, problem=problem, settings=planner.settings)
    assert found.count < 0.65 * plain.count


def test_a_system_that_observes_otherwise_keeps_its_observation():
    class Doubled(System):
        state_names, action_names = ("x", "v"), ("force",)
        velocity_of = {"x": "v"}
        default_constants = {"mass": 2.0}

        def prior(self, state, action, constants):
            return torch.stack([state[..., 1], action[..., 0] / constants["mass"]], -1)

        def observe(self, state):
            return 2.0 * state

        def locate(self, observation):
            return observation / 2.0

    task = Task(
        name="doubled",
        system=Doubled(),
        action_high=(1.0,),
        time_step=0.1,
        max_steps=10,
        reset=get_task("pendulum").reset,
        reward=lambda state, action, next_state: -next_state.square().sum(-1),
    )
    torch.testing.assert_close(*both(make(task)), atol=1e-4, rtol=1e-4)


def test_a_task_that_steps_otherwise_is_left_alone():
    class Lazy(type(get_task("pendulum"))):
        def transition(self, step, state, action):
            return super().transition(step, state, 0.0 * action)

    task = get_task("pendulum")
    fields = {k: getattr(task, k) for k in ("system", "action_high", "time_step", "max_steps")}
    lazy = Lazy(name="lazy", reset=task.reset, reward=task.reward, **fields)
    model = TaskWorldModel(lazy, HybridDynamics.hybrid(lazy))
    assert model.prepared() is model
    assert isinstance(TaskWorldModel(task, model.transitions).prepared(), PreparedModel)
