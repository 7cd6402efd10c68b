"""CEMPlanner as a module: batches, backends, modules of every kind, copies, nested keys."""

from __future__ import annotations

import copy

import pytest
import torch
from lopsided import LOPSIDED
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule, TanhModule

from phihp_torchrl import CEMPlanner, WorldModelEnv
from phihp_torchrl.agents import TwinQ
from phihp_torchrl.tasks import get_task
from phihp_torchrl.worlds import SimulatedWorld

from .planner_parts import Concatenate, InBounds, make_planner, noise_for, task_parts

TASKS = ["pendulum-swingup", "cartpole", "acrobot", "acrobot-swingup", LOPSIDED]


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_actions_of_any_batch_shape_are_in_bounds(name, batch):
    task, env, actor, qvalue = task_parts(name)
    planner = make_planner(env, actor, qvalue)
    observation = task.observe(task.coverage.sample(batch))
    action = planner(TensorDict(observation=observation, batch_size=batch))["action"]
    assert action.shape == (*batch, task.action_dim)
    assert (action >= task.bounds.low).all()
    assert (action <= task.bounds.high).all()
    assert not action.requires_grad
    assert planner.in_keys == ["observation"]
    assert planner.out_keys == ["action"]


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("hybrid", [True, False])
def test_tensors_and_environment_give_the_same_action(name, hybrid):
    """CartPole and Acrobot start where they may end within the horizon."""
    task, env, actor, qvalue = task_parts(name)
    modules = (actor, qvalue) if hybrid else ()
    planners = [make_planner(env, *modules, backend=backend) for backend in ("tensor", "env")]
    assert [planner.uses_tensors for planner in planners] == [True, False]
    observation = task.observe(task.coverage.sample((2, 3)))
    tensordict = TensorDict(observation=observation, batch_size=[2, 3])
    noise = noise_for(planners[0], (2, 3))
    plans = [planner.plan(tensordict, noise) for planner in planners]
    torch.testing.assert_close(*(found.actions for found in plans))
    torch.testing.assert_close(*(found.score for found in plans))


def test_the_same_generator_gives_the_same_actions():
    _, env, actor, qvalue = task_parts("pendulum")
    tensordict = TensorDict(observation=torch.tensor([0.0, 1.0, 0.0]))

    def actions(seed):
        generator = torch.Generator().manual_seed(seed)
        planner = make_planner(env, actor, qvalue, generator=generator)
        return torch.stack([planner(tensordict.clone())["action"] for _ in range(3)])

    assert torch.equal(actions(1), actions(1))
    assert not torch.equal(actions(1), actions(2))


def test_the_oracle_plan_holds_the_cartpole():
    env = WorldModelEnv(SimulatedWorld("cartpole").model())
    torch.manual_seed(0)
    planner = CEMPlanner(env, 30, 2, 60, 8)
    assert env.rollout(40, planner)["next", "reward"].sum() == 40


# Actors and critics of other people.


def test_modules_of_every_kind_are_the_same_function():
    _, env, _, _ = task_parts("pendulum")
    network = nn.Linear(3, 1)
    bounds = get_task("pendulum").bounds
    plain = TensorDictModule(nn.Sequential(network, InBounds(bounds)), ["observation"], ["action"])
    chain = TensorDictSequential(
        TensorDictModule(network, ["observation"], ["raw"]),
        TensorDictModule(InBounds(bounds), ["raw"], ["action"]),
    )
    stock = TensorDictSequential(
        TensorDictModule(network, ["observation"], ["action"]),
        TanhModule(in_keys=["action"], low=-2.0, high=2.0),
    )
    hooked = copy.copy(plain)
    hooked._forward_hooks = plain._forward_hooks.copy()
    calls = []
    hooked.register_forward_hook(lambda *_: calls.append(1))
    tensordict = TensorDict(observation=torch.tensor([0.0, 1.0, 0.0]))
    actions = []
    for actor in (plain, chain, stock, hooked):
        for backend in ("tensor", "env"):
            planner = make_planner(env, actor, backend=backend)
            actions.append(planner.planning(tensordict, noise_for(planner)))
    for action in actions[1:]:
        torch.testing.assert_close(action, actions[0])
    assert calls


def test_an_exploring_actor_does_not_explore_in_plans():
    _, env, actor, _ = task_parts("pendulum")
    exploring = TensorDictSequential(actor, AdditiveGaussianModule(env.action_spec))
    tensordict = TensorDict(observation=torch.tensor([0.0, 1.0, 0.0]))
    scores = []
    with set_exploration_type(ExplorationType.RANDOM):
        for module in (actor, exploring):
            planner = make_planner(env, module)
            scores.append(planner.plan(tensordict, noise_for(planner)).score)
    assert torch.equal(*scores)


@pytest.mark.parametrize("stacked", [True, False])
def test_the_smallest_value_counts(stacked):
    task, env, actor, _ = task_parts("pendulum")
    heads = nn.ModuleList(Concatenate(nn.Linear(4, 1)) for _ in range(2))

    class Twin(nn.Module):
        def forward(self, observation, action):
            values = [head(observation, action) for head in heads]
            return torch.stack(values) if stacked else torch.cat(values, -1)

    class Smallest(nn.Module):
        def forward(self, observation, action):
            return torch.minimum(*(head(observation, action) for head in heads))

    keys = ["observation", "action"], ["q"]
    tensordict = TensorDict(observation=task.observe(task.reset.sample([3])), batch_size=[3])
    actions = []
    for network in (Twin(), Smallest()):
        planner = make_planner(env, actor, TensorDictModule(network, *keys), value_key="q")
        actions.append(planner.planning(tensordict, noise_for(planner, (3,))))
    assert torch.equal(*actions)


def test_a_copy_has_modules_of_its_own():
    _, env, actor, qvalue = task_parts("pendulum")
    planner = make_planner(env, actor, qvalue, generator=torch.Generator())
    tensordict, noise = TensorDict(observation=torch.tensor([0.0, 1.0, 0.0])), noise_for(planner)
    before = planner.plan(tensordict, noise).score
    other = copy.deepcopy(planner)
    with torch.no_grad():
        for parameter in other.actor.parameters():
            parameter.fill_(10.0)
    assert not torch.equal(other.plan(tensordict, noise).score, before)
    assert torch.equal(planner.plan(tensordict, noise).score, before)


def test_an_actor_may_read_the_models_state():
    """Then the environment is stepped, and needs the state."""
    task, env, _, _ = task_parts("pendulum")
    actor = TensorDictModule(nn.Linear(2, 1), ["state"], ["action"])
    planner = make_planner(env, actor)
    assert not planner.uses_tensors
    assert planner.in_keys == ["observation", "state"]
    assert env.rollout(3, planner)["action"].shape == (3, 1)
    with pytest.raises(ValueError, match="state: expected a tensor"):
        planner(TensorDict(observation=task.observe(torch.zeros(2))))


# Reduced precision beyond the horizon.


@pytest.mark.parametrize("backend", ["tensor", "env"])
def test_tail_in_bfloat16(backend):
    task, env, actor, qvalue = task_parts("pendulum")
    tensordict = TensorDict(observation=task.observe(task.coverage.sample([4])), batch_size=[4])
    full, reduced = (
        make_planner(env, actor, qvalue, tail_dtype=dtype, backend=backend)
        for dtype in ("float32", "bfloat16")
    )
    noise = noise_for(full, (4,))
    plans = [planner.plan(tensordict, noise) for planner in (full, reduced)]
    assert plans[1].score.dtype == torch.float32
    assert not torch.equal(plans[0].score, plans[1].score), "the tail is another one"
    torch.testing.assert_close(plans[0].score, plans[1].score, rtol=2e-2, atol=2e-2)


def test_the_last_layer_of_a_reduced_tail_is_exact():
    """A value of 300 in bfloat16 would be off by up to one."""
    task = get_task("pendulum")
    critics = TwinQ(task, (8,))
    with torch.no_grad():
        critics.layers[-1].fill_(300.3)
        critics.layers[-2].zero_()
        with torch.autocast("cpu", torch.bfloat16):
            values = critics(torch.zeros(3, 3), torch.zeros(3, 1))
    assert values.dtype == torch.float32
    assert torch.equal(values, torch.full((3, 2), 300.3))
