"""Planners in other people's pipelines: sent to processes, changed, with inputs of any strides."""

from __future__ import annotations

import copy
import logging
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from spawned import send
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Composite
from torchrl.objectives.value import TDLambdaEstimator

from phihp_torchrl import MPPIPlanner
from phihp_torchrl.planners import MPPIConfig
from phihp_torchrl.planners.plan_functions import _MOST, PlanFunctions, _laid_out

from .planner_parts import make_planner, noise_for, task_parts

SMALL = MPPIConfig(3, 2, 16, 4, num_policy_candidates=4)


def both(generator=None):
    task, env, actor, qvalue = task_parts("pendulum")
    parts = {"actor": actor, "qvalue": qvalue, "generator": generator}
    return task, [make_planner(env, warm_start=True, **parts), MPPIPlanner(env, SMALL, **parts)]


# Sent to another process.


def test_planners_can_be_sent_and_go_on_alike():
    _, planners = both(torch.Generator().manual_seed(3))
    start = TensorDict(observation=torch.tensor([[0.0, 1.0, 0.0]]), batch_size=[1])
    for planner in planners:
        planner(start.clone())
        for other in (send(planner), copy.deepcopy(planner)):
            assert other.generator is not planner.generator
            assert torch.equal(other.generator.get_state(), planner.generator.get_state())
            expected = copy.deepcopy(planner)(start.clone())["action"]
            assert torch.equal(other(start.clone())["action"], expected)


def test_environments_can_be_sent_and_reset_alike():
    _, env, _, _ = task_parts("cartpole")
    other = send(env)
    assert torch.equal(env.reset()["state"], other.reset()["state"])


# Attributes.


@pytest.mark.parametrize("backend", ["tensor", "env"])
def test_what_is_assigned_takes_effect(backend):
    task, env, actor, qvalue = task_parts("pendulum")
    _, _, other_actor, other_qvalue = task_parts("pendulum", seed=5)
    planner = make_planner(env, actor, qvalue, backend=backend)
    tensordict = TensorDict(observation=task.observe(task.reset.sample([3])), batch_size=[3])
    noise = noise_for(planner, (3,))
    changes = {
        "actor": other_actor,
        "qvalue": other_qvalue,
        "settings": replace(planner.settings, gamma=0.5),
        "planning_horizon": 3,
    }
    arguments = {"actor": actor, "qvalue": qvalue, "gamma": 0.99, "planning_horizon": 4}
    for name, value in changes.items():
        planner.plan(tensordict, noise)
        setattr(planner, name, value)
        assert getattr(planner, name) is value or getattr(planner, name) == value
        arguments |= {"gamma": 0.5} if name == "settings" else {name: value}
        noise = noise[:, : arguments["planning_horizon"]]
        fresh = make_planner(env, **arguments, backend=backend)
        found, expected = planner.plan(tensordict, noise), fresh.plan(tensordict, noise)
        assert torch.equal(found.actions, expected.actions), name
        assert torch.equal(found.score, expected.score), name


def test_what_does_not_fit_is_refused_and_nothing_changes():
    _, env, actor, qvalue = task_parts("pendulum")
    planner = make_planner(env, actor, qvalue)
    wrong = {
        "actor": TensorDictModule(nn.Linear(3, 1), ["elsewhere"], ["action"]),
        "qvalue": actor,
        "settings": SMALL,
        "env": env,
    }
    for name, value in wrong.items():
        before = getattr(planner, name)
        with pytest.raises(ValueError, match=f"^{name}: expected"):
            setattr(planner, name, value)
        assert getattr(planner, name) is before
    with pytest.raises(ValueError, match=r"^top_k: expected at most num_candidates = 32, got 99"):
        planner.top_k = 99
    assert planner.top_k == 5
    planner.qvalue = None
    planner.settings = replace(planner.settings, num_policy_candidates=0, warm_start=True)
    planner.actor = None
    assert planner.problem().actor is None
    assert planner.in_keys == ["observation", "is_init"]


def test_attributes_of_stock_planners():
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env)
    assert (planner.planning_horizon, planner.optim_steps) == (4, 2)
    assert (planner.num_candidates, planner.top_k) == (32, 5)
    assert planner.spec == env.full_action_spec
    assert isinstance(planner.spec, Composite)
    assert planner.in_keys == ["observation"]
    mppi = MPPIPlanner(env, None, 1.0, 3, 2, 16, 4)
    assert (mppi.temperature, mppi.planning_horizon, mppi.in_keys[-1]) == (1.0, 3, "is_init")
    given = TensorDict(observation=torch.zeros(2, 3), batch_size=[2])
    out = TensorDict(batch_size=[2])
    assert planner(given, tensordict_out=out) is out
    assert list(given.keys()) == ["observation"]


def test_the_keys_to_read_can_be_given():
    _, env, actor, _ = task_parts("pendulum")
    assert make_planner(env, backend="env", in_keys=["state"]).in_keys == ["state"]
    start = env.reset().exclude("observation")
    assert make_planner(env, backend="env", in_keys=["state"])(start)["action"].abs() <= 2
    for keys, actor_ in ((["elsewhere"], None), (["state"], actor)):
        with pytest.raises(ValueError, match=r"^in_keys: expected"):
            make_planner(env, actor_, in_keys=keys)


def test_done_keys_may_be_those_of_stock_planners():
    _, env, _, _ = task_parts("pendulum")
    assert make_planner(env, done_keys="done").done_keys == [("next", "done")]


def test_an_actor_that_has_no_use_is_said(caplog):
    _, env, actor, qvalue = task_parts("pendulum")
    with caplog.at_level(logging.WARNING, logger="phihp_torchrl"):
        make_planner(env, actor, qvalue, num_policy_candidates=0)
        assert not caplog.records
        make_planner(env, actor, num_policy_candidates=0)
    assert "acts by its actor only where no sequence has a finite score" in caplog.text


# The signature of the stock path integral planner.


def test_an_advantage_module_scores_as_the_return_does():
    """With λ = 1, γ = 1 and no value the λ-return is the sum of rewards."""
    _, env, _, _ = task_parts("pendulum")

    class Flat(nn.Module):
        def forward(self, observation):
            return 0.0 * observation[..., :1]

    value = TensorDictModule(Flat(), ["observation"], ["state_value"])
    module = TDLambdaEstimator(gamma=1.0, lmbda=1.0, value_network=value)
    start = TensorDict(observation=torch.tensor([[0.0, 1.0, 0.0]] * 3), batch_size=[3])
    sizes = {"planning_horizon": 3, "optim_steps": 2, "num_candidates": 16, "top_k": 4}
    by_advantage = MPPIPlanner(env, module, 1.0, **sizes)
    by_return = MPPIPlanner(env, None, temperature=1.0, gamma=1.0, **sizes)
    noise = by_return.draw_noise([3])
    found, expected = (p.plan(start, noise) for p in (by_advantage, by_return))
    torch.testing.assert_close(found.score, expected.score)
    torch.testing.assert_close(found.mean, expected.mean)


def test_settings_and_numbers_together_are_refused():
    _, env, actor, _ = task_parts("pendulum")
    with pytest.raises(ValueError, match=r"^settings: expected these alone or"):
        MPPIPlanner(env, SMALL, 1.0, actor=actor)
    with pytest.raises(ValueError, match=r"^actor: expected none beside an advantage_module"):
        MPPIPlanner(env, nn.Linear(1, 1), 1.0, 3, 2, 16, 4, actor=actor)


# One graph for a shape.


def strided(shape, seed):
    """A tensor of this shape as it may lie in somebody's memory."""
    generator = torch.Generator().manual_seed(seed)
    steps = torch.randint(1, 4, [len(shape)], generator=generator).tolist()
    order = torch.randperm(len(shape), generator=generator).tolist()
    whole = torch.randn([shape[d] * steps[d] for d in order], generator=generator)
    there = [order.index(d) for d in range(len(shape))]
    cut = whole.permute(there)
    for d, step in enumerate(steps):
        cut = cut.transpose(0, d)[::step].transpose(0, d)
    return cut


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 4), max_size=4), st.integers(0, 10**6))
def test_inputs_of_graphs_lie_in_one_way(shape, seed):
    given_ = strided(shape, seed) if shape else torch.randn(3)[1]
    found = _laid_out(given_)
    assert torch.equal(found, given_)
    assert found.stride() == torch.empty(shape).stride()


def test_a_compiled_plan_has_one_graph_for_all_strides():
    torch._dynamo.reset()
    graphs = []

    def backend(graph, _):
        graphs.append(graph)
        return graph.forward

    _, env, _, _ = task_parts("pendulum")
    sizes = {"planning_horizon": 1, "optim_steps": 1, "num_candidates": 4, "top_k": 2}
    planner = make_planner(env, **sizes, compile={"backend": backend})
    eager = make_planner(env, **sizes)
    for seed in range(12):
        observation = torch.nn.functional.normalize(strided([2, 3], seed), dim=-1)
        tensordict = TensorDict(observation=observation, batch_size=[2])
        noise = strided(planner.settings.noise_shape((2,), 1), seed)
        found, expected = planner.plan(tensordict, noise), eager.plan(tensordict, noise)
        torch.testing.assert_close(found, expected)
    assert len(graphs) == 1


def test_the_functions_of_a_planner_are_bounded():
    functions, built = PlanFunctions(), []

    def build():
        built.append(len(built))
        return lambda observation: observation.sum()

    for size in range(1, 3 * _MOST):
        functions.call(build, True, torch.ones(size))
        functions.call(build, True, torch.ones(1))  # which is used all the time
    assert len(functions) == _MOST
    assert len(built) == 3 * _MOST - 1
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env)
    for size in range(4):
        planner(env.reset(TensorDict(batch_size=[size])))
    assert len(planner._functions) == 1, "what is not compiled takes every shape"
