"""A compiled step is the step, for any number of rows, with the weights that the model has now."""

from __future__ import annotations

import copy
import pickle
from functools import partial

import pytest
import torch

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.dynamics import PreparedModel, TaskWorldModel, compiled_step
from phihp_torchrl.dynamics.compiled_step import CompiledStep, count_operations
from phihp_torchrl.integrators import RK4
from phihp_torchrl.systems import Constant


@pytest.fixture
def traced(monkeypatch):
    """Compile without making machine code, which takes long."""
    quick = partial(compile_graph, backend="eager")
    monkeypatch.setattr(compiled_step, "compile_graph", quick)


def made(name="cartpole", integrator=None):
    torch.manual_seed(0)
    task = get_task(name)
    return HybridDynamics.hybrid(task, integrator=integrator or "rk4")


def drawn(dynamics, rows):
    task = dynamics.task
    return task.coverage.sample([rows]), task.action_high[0] * torch.randn(rows, task.action_dim)


@pytest.mark.parametrize("name", ["pendulum", "acrobot"])
def test_it_is_the_step_for_any_number_of_rows(traced, name):
    dynamics = made(name)
    dynamics.compile_step()
    with torch.no_grad(), torch._dynamo.config.patch(error_on_recompile=True):
        for rows in (7, 1, 64, 2):
            state, action = drawn(dynamics, rows)
            expected = dynamics.step(state, action)
            torch.testing.assert_close(dynamics.compiled_step(state, action), expected)
            # Rows of a wider tensor, and the same row many times.
            wide = torch.cat([state, state], -1)[:, : state.shape[-1]]
            torch.testing.assert_close(dynamics.compiled_step(wide, action), expected)
            alike = state[:1].expand(rows, -1)
            found = dynamics.compiled_step(alike, action)
            torch.testing.assert_close(found, dynamics.step(alike, action))


@pytest.mark.slow
def test_machine_code_is_the_step_too():
    dynamics = made("pendulum", "semi_implicit_euler")
    dynamics.compile_step()
    with torch.no_grad():
        for rows in (1, 5, 9):
            state, action = drawn(dynamics, rows)
            found = dynamics.compiled_step(state, action)
            torch.testing.assert_close(found, dynamics.step(state, action), atol=1e-5, rtol=1e-5)


def test_it_follows_weights_and_constants(traced):
    dynamics = made()
    dynamics.compile_step()
    state, action = drawn(dynamics, 3)
    with torch.no_grad():
        before = dynamics.compiled_step(state, action)
        for parameter in dynamics.parameters():
            parameter.add_(0.3)
        after = dynamics.compiled_step(state, action)
        torch.testing.assert_close(after, dynamics.step(state, action))
        assert not torch.allclose(before, after)
        dynamics.double()
        wider = dynamics.compiled_step(state.double(), action.double())
    torch.testing.assert_close(wider, dynamics.step(state.double(), action.double()))


def test_bounded_constants_compile(traced):
    class Bounded(type(get_task("pendulum").system)):
        default_constants = {
            "gravity": 9.8,
            "mass": Constant(0.7, low=0.0, high=2.0),
            "length": Constant(1.0, fixed=True),
        }

    task = copy.copy(get_task("pendulum"))
    object.__setattr__(task, "system", Bounded())
    dynamics = HybridDynamics.pure_prior(task)
    dynamics.compile_step()
    state, action = drawn(dynamics, 3)
    with torch.no_grad():
        found = dynamics.compiled_step(state, action)
        torch.testing.assert_close(found, dynamics.step(state, action))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_has_its_own_weights_and_no_graph(traced, copied):
    dynamics = made("pendulum")
    dynamics.compile_step()
    state, action = drawn(dynamics, 2)
    with torch.no_grad():
        dynamics.compiled_step(state, action)
    assert copied(dynamics).compiled_step is None
    assert dynamics.compiled_step is not None


def test_an_adaptive_integrator_is_left_alone():
    dynamics = made("pendulum", "dopri5")
    dynamics.compile_step()
    assert dynamics.compiled_step is None


def test_plans_and_imagination_take_it_where_nothing_is_differentiated(traced):
    dynamics = made()
    task, (state, action) = dynamics.task, drawn(dynamics, 4)
    model = TaskWorldModel(task, dynamics)
    with torch.no_grad():
        expected = model.transition(state, action)
    dynamics.compile_step()
    calls = []
    step = dynamics.compiled_step
    dynamics.compiled_step = lambda *arguments: calls.append(0) or step(*arguments)
    with torch.no_grad():
        found = model.prepared().transition(state, action)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)
    assert len(calls) == 1
    model.transition(state.requires_grad_(), action).next_state.sum().backward()
    assert state.grad is not None
    assert len(calls) == 1


def test_operations_are_those_of_a_prepared_step():
    counts = [
        PreparedModel(made("cartpole", solver).task, made("cartpole", solver), torch.empty(0))
        for solver in ("semi_implicit_euler", RK4(), RK4(substeps=2))
    ]
    few, more, most = (model.operations for model in counts)
    assert 20 < few < more / 2
    assert most == pytest.approx(2 * more, rel=0.1)


def test_rows_below_two_share_the_graph():
    seen = []
    step = CompiledStep(lambda state, action: state + action)
    step._step = lambda state, action: seen.append(len(state)) or state + action
    assert step(torch.ones(1, 2), torch.ones(1, 2)).tolist() == [[2.0, 2.0]]
    assert step(torch.ones(1, 2), torch.zeros(1, 2)).shape == (1, 2)
    assert seen == [2, 2]
    assert count_operations(lambda s, a: s * 2 + a, torch.ones(2), torch.ones(2)) == 2
