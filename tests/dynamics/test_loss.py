"""The model's loss: by hand, on the circle, and as a TorchRL loss."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn
from torchrl.objectives import LossModule

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import DynamicsLoss, PhysicsPrior
from phihp_torchrl.worlds import PlantPhysics, SimulatedWorld, find_plant

from .draws import draw

TASK = get_task("pendulum")
WORLD = SimulatedWorld(TASK)


class Constant(nn.Module):
    """A residual of the same value everywhere."""

    def __init__(self, *values: float) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.tensor(values))

    def forward(self, state, action):
        return self.values.expand_as(state)


def transitions(state, action, next_state, task=TASK):
    observe = task.observe
    following = TensorDict(observation=observe(next_state), batch_size=state.shape[:-1])
    return TensorDict(
        observation=observe(state), action=action, next=following, batch_size=state.shape[:-1]
    )


def real_transitions(task=TASK, count=64):
    state, action = draw(task, count)
    return transitions(state, action, SimulatedWorld(task).step(state, action), task)


def world_with(residual):
    """The true world and a residual on top, so that all error is the residual's."""
    return HybridDynamics(TASK, prior=PlantPhysics(find_plant(TASK.system)), residual=residual)


def raw_world_transitions(count=8):
    state = torch.empty(count, 2).uniform_(-1.0, 1.0)
    action = torch.empty(count, 1).uniform_(-1.0, 1.0)
    return state, action, WORLD.step(state, action)


# By hand


def test_by_hand():
    # Semi-implicit Euler: a residual (0, 2) changes theta_dot by 0.05 * 2 and theta by 0.05 * that.
    loss = DynamicsLoss(world_with(Constant(0.0, 2.0)), lambda_0=4.0)
    result = loss(transitions(*raw_world_transitions()))
    assert result["loss_prediction"].item() == pytest.approx(0.1**2 + 0.005**2, rel=1e-3)
    assert result["residual_norm"].item() == pytest.approx(2.0)
    assert result["loss_residual"].item() == pytest.approx(2.0 / 4.0)


def test_penalty_is_the_mean_of_norms():
    class OfTheAngle(nn.Module):
        def forward(self, state, action):
            return torch.stack([3 * state[..., 1], 4 * state[..., 1]], -1)

    state = torch.tensor([[0.0, 1.0], [0.0, -2.0]])
    action = torch.zeros(2, 1)
    loss = DynamicsLoss(world_with(OfTheAngle()), lambda_0=10.0)
    result = loss(transitions(state, action, WORLD.step(state, action)))
    assert result["residual_norm"].item() == pytest.approx((5 + 10) / 2)
    assert result["loss_residual"].item() == pytest.approx(0.75)


def test_the_world_has_no_error():
    loss = DynamicsLoss(WORLD.oracle())
    assert loss(real_transitions())["loss_prediction"] < 1e-10


def test_angles_are_compared_on_the_circle():
    # Half a turn, crossed in either direction.
    for velocity in (1.0, -1.0):
        state = torch.tensor([[math.copysign(math.pi - 0.01, velocity), velocity]])
        action = torch.zeros(1, 1)
        next_state = WORLD.step(state, action)
        assert next_state.abs()[0, 0] > math.pi
        assert (
            DynamicsLoss(WORLD.oracle())(transitions(state, action, next_state))["loss_prediction"]
            < 1e-8
        )


def test_no_residual_no_penalty():
    result = DynamicsLoss(HybridDynamics.pure_prior(TASK))(real_transitions())
    assert result["loss_residual"] == 0
    assert result["residual_norm"] == 0
    assert result["loss_prediction"] > 0


def test_batch_shape_changes_nothing():
    data = real_transitions(count=24)
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK))
    for name, value in loss(data).items():
        torch.testing.assert_close(loss(data.reshape(2, 3, 4))[name], value)


# Lambda


def test_lambda_grows_with_the_error():
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK), lambda_0=2.0, tau_ph=10.0)
    for error, expected in ((0.5, 7.0), (0.0, 7.0), (0.1, 8.0)):
        loss.update_lambda(torch.tensor(error))
        assert loss.lambda_.item() == pytest.approx(expected)
    data = real_transitions()
    first = loss(data)
    loss.lambda_.mul_(4.0)
    second = loss(data)
    assert second["loss_residual"].item() == pytest.approx(first["loss_residual"].item() / 4)
    assert torch.equal(second["loss_prediction"], first["loss_prediction"])


def test_lambda_and_scales_are_state():
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK), lambda_0=2.0, tau_ph=10.0)
    data = real_transitions()
    loss.set_scales(data)
    loss.update_lambda(torch.tensor(0.5))
    other = DynamicsLoss(HybridDynamics.hybrid(TASK))
    other.load_state_dict(loss.state_dict())
    assert other.lambda_ == 7.0
    for name, value in loss(data).items():
        assert torch.equal(other(data)[name], value)


# Scales


def test_set_scales_by_hand():
    # Two transitions whose one-step changes are (0, ±0.1): a std of 0.1 sqrt(2) in theta_dot.
    state = torch.zeros(2, 2)
    next_state = torch.tensor([[0.0, 0.1], [0.0, -0.1]])
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK))
    loss.set_scales(transitions(state, torch.zeros(2, 1), next_state))
    deviation = 0.1 * math.sqrt(2)
    assert loss.error_scale.tolist() == pytest.approx([0.05 * 1e-3, deviation], rel=1e-4)
    assert loss.residual_scale.tolist() == pytest.approx([1e-3, deviation / 0.05], rel=1e-4)
    assert loss.dynamics.residual.output_scale.tolist() == pytest.approx(
        [deviation / 0.05], rel=1e-4
    )


def test_errors_and_residual_are_measured_in_scales():
    loss = DynamicsLoss(world_with(Constant(0.0, 2.0)), lambda_0=4.0)
    loss.error_scale.copy_(torch.tensor([0.005, 0.05]))
    loss.residual_scale.copy_(torch.tensor([1.0, 0.5]))
    result = loss(transitions(*raw_world_transitions()))
    assert result["loss_prediction"].item() == pytest.approx(1.0 + 4.0, rel=1e-3)
    assert result["residual_norm"].item() == pytest.approx(4.0)


def test_scaled_errors_do_not_depend_on_units():
    # A model that predicts no change errs by about one scale in each component.
    class Standstill(nn.Module):
        def forward(self, state, action):
            return torch.zeros_like(state)

    task = get_task("cartpole-swingup")
    data = real_transitions(task, 500)
    loss = DynamicsLoss(HybridDynamics(task, prior=Standstill(), residual=None))
    loss.set_scales(data)
    error, _ = loss.terms(*loss.transitions(data))
    torch.testing.assert_close(error.square().mean(0), torch.ones(4), rtol=0.1, atol=0.1)


@pytest.mark.parametrize("count", [1, 2])
def test_scales_of_hardly_any_transitions_are_finite(count):
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK))
    data = real_transitions(count=count)
    loss.set_scales(data)
    assert all(value.isfinite() for value in loss(data).values())
    assert loss.error_scale.min() > 0


# As a TorchRL loss


def test_is_a_loss_module():
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK))
    assert isinstance(loss, LossModule)
    ours = {id(parameter) for parameter in loss.parameters()}
    assert ours == {id(parameter) for parameter in loss.dynamics.parameters()}
    data = real_transitions(count=256)
    assert set(loss(data).keys()) == set(loss.out_keys)
    assert not loss(data)["residual_norm"].requires_grad
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    errors = []
    for _ in range(50):
        result = loss(data)
        (result["loss_prediction"] + result["loss_residual"]).backward()
        optimizer.step()
        optimizer.zero_grad()
        errors.append(result["loss_prediction"].item())
    assert errors[-1] < 0.1 * errors[0]


def test_penalty_shrinks_the_residual():
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK), lambda_0=1.0)
    data = real_transitions()
    before = loss(data)
    optimizer = torch.optim.SGD(loss.dynamics.residual.parameters(), lr=1e-3)
    for _ in range(20):
        loss(data)["loss_residual"].backward()
        optimizer.step()
        optimizer.zero_grad()
    assert loss(data)["residual_norm"] < before["residual_norm"]


@pytest.mark.parametrize("key", ["obs", ("agent", "obs")])
def test_keys_can_be_set(key):
    data = real_transitions()
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK))
    expected = loss(data)
    loss.set_keys(observation=key, action=("agent", "torque"))
    named = TensorDict(batch_size=data.batch_size)
    named[key] = data["observation"]
    named["agent", "torque"] = data["action"]
    named["next"] = TensorDict(batch_size=data.batch_size)
    named["next"][key] = data["next", "observation"]
    for name, value in expected.items():
        assert torch.equal(loss(named)[name], value)
    # in_keys are plain keys of that tensordict
    assert set(loss.in_keys) == set(named.keys(include_nested=True, leaves_only=True))
    assert torch.equal(
        loss(named.select(*loss.in_keys))["loss_prediction"], expected["loss_prediction"]
    )


def test_unknown_key():
    with pytest.raises(ValueError, match="reward"):
        DynamicsLoss(HybridDynamics.hybrid(TASK)).set_keys(reward="r")


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"lambda_0": 0.0}, "lambda_0"),
        ({"lambda_0": -1.0}, "lambda_0"),
        ({"lambda_0": math.nan}, "lambda_0"),
        ({"tau_ph": -1.0}, "tau_ph"),
        ({"tau_ph": math.nan}, "tau_ph"),
        ({"lambda_0": math.inf}, "lambda_0"),
    ],
)
def test_errors_name_the_argument(options, name):
    with pytest.raises(ConfigError, match=f"^{name}: expected "):
        DynamicsLoss(HybridDynamics.hybrid(TASK), **options)


SHAPES = st.lists(st.integers(0, 3), max_size=3)


@settings(max_examples=30, deadline=None)
@given(batch=st.lists(st.integers(0, 3), max_size=2), other=SHAPES, number=st.integers(0, 3))
def test_transitions_of_any_shape_give_a_number_or_are_refused_by_name(batch, other, number):
    """A shape that broadcasts would give a wrong number without a word."""
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK))
    sizes = {"observation": TASK.observation_dim, "action": TASK.action_dim}
    sizes["next_observation"] = TASK.observation_dim
    shapes = {name: [*batch, size] for name, size in sizes.items()}
    right = dict(shapes)
    if number < 3:
        shapes[list(shapes)[number]] = other
    given_ = {name: torch.rand(shape) for name, shape in shapes.items()}
    if 0 in batch or shapes != right:
        named = r"^(observation|action|next\.observation|tensordict): expected"
        with pytest.raises(ConfigError, match=named):
            loss(**given_)
    else:
        assert all(value.isfinite() for value in loss(**given_))


@pytest.mark.parametrize("key", ["observation", "action", ("next", "observation")])
def test_a_missing_key_is_named(key):
    data = real_transitions(count=8).exclude(key)
    with pytest.raises(ConfigError, match=r"^(next\.)?(observation|action): expected shape"):
        DynamicsLoss(HybridDynamics.hybrid(TASK))(data)


def test_gradients_reach_prior_and_residual_alike():
    loss = DynamicsLoss(HybridDynamics.hybrid(TASK))
    loss(real_transitions())["loss_prediction"].backward()
    assert isinstance(loss.dynamics.prior, PhysicsPrior)
    for name, parameter in loss.dynamics.named_parameters():
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


def test_tensors_may_be_given_by_name():
    task = get_task("pendulum")
    loss = DynamicsLoss(HybridDynamics.hybrid(task))
    seen, following = task.observe(task.reset.sample([2, 8])).unbind(0)
    action = torch.ones(8, 1)
    following_td = TensorDict(observation=following, batch_size=[8])
    data = TensorDict(observation=seen, action=action, next=following_td, batch_size=[8])
    expected = loss(data)
    found = loss(observation=seen, action=action, next_observation=following)
    assert [float(value) for value in found] == [float(expected[key]) for key in loss.out_keys]
