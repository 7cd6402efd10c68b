"""Rows of a batch are lives: each has its member and its constants, and keeps them."""

from __future__ import annotations

import pytest
import torch

from phihp_torchrl import HybridDynamics, TaskWorldModel, get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import PhysicsPrior, per_life
from phihp_torchrl.systems import Constant, Pendulum

from .draws import draw

PENDULUM = get_task("pendulum")


def alone(dynamics, index):
    """The model with one member of the ensemble."""
    return HybridDynamics(
        dynamics.task, prior=dynamics.prior, residual=dynamics.residual.member(index)
    )


def with_constants(dynamics, shift):
    prior = PhysicsPrior(dynamics.task.system)
    prior.log_constants.data.copy_(dynamics.prior.log_constants.detach() + shift)
    return HybridDynamics(dynamics.task, prior=prior, residual=dynamics.residual)


def test_without_members_or_shifts_it_is_the_model_itself():
    dynamics = HybridDynamics.hybrid(PENDULUM)
    assert per_life(dynamics) is dynamics


def test_rows_move_by_their_member():
    dynamics = HybridDynamics.hybrid(PENDULUM, ensemble=3)
    state, action = draw(PENDULUM, 8)
    moved = per_life(dynamics)(state, action)
    for row in range(8):
        expected = alone(dynamics, row % 3)(state[row], action[row])
        torch.testing.assert_close(moved[row], expected)


def test_rows_move_by_their_constants():
    dynamics = HybridDynamics.hybrid(PENDULUM)
    shifts = 0.2 * torch.randn(4, 3)
    state, action = draw(PENDULUM, 6)
    moved = per_life(dynamics, shifts)(state, action)
    for row in range(6):
        expected = with_constants(dynamics, shifts[row % 4])(state[row], action[row])
        torch.testing.assert_close(moved[row], expected)


def test_rows_are_counted_through_all_dimensions():
    dynamics = HybridDynamics.hybrid(PENDULUM, ensemble=2)
    view = per_life(dynamics, 0.1 * torch.randn(3, 3))
    state, action = draw(PENDULUM, 12)
    folded = view(state.reshape(3, 4, -1), action.reshape(3, 4, -1))
    torch.testing.assert_close(folded.reshape(12, -1), view(state, action))
    torch.testing.assert_close(view(state[0], action[0]), view(state, action)[0])


def test_a_life_keeps_its_model_through_a_rollout():
    dynamics = HybridDynamics.hybrid(PENDULUM, ensemble=2)
    state, action = draw(PENDULUM, 4)
    actions = action[:, None].expand(-1, 10, -1)
    rolled = per_life(dynamics).rollout(state, actions)
    for row in range(4):
        expected = alone(dynamics, row % 2).rollout(state[row], actions[row])
        torch.testing.assert_close(rolled[row], expected)


def test_the_model_itself_stays_the_mean_and_later_weights_take_effect():
    dynamics = HybridDynamics.hybrid(PENDULUM, ensemble=2)
    state, action = draw(PENDULUM, 4)
    before = dynamics(state, action)
    view = per_life(dynamics)
    assert torch.equal(dynamics(state, action), before)
    seen = view(state, action)
    with torch.no_grad():
        dynamics.residual.network.biases[-1].add_(1.0)
    assert not torch.equal(view(state, action), seen)


def test_it_compiles_as_one_graph():
    dynamics = HybridDynamics.hybrid(PENDULUM, ensemble=2)
    model = TaskWorldModel(PENDULUM, per_life(dynamics, 0.1 * torch.randn(3, 3)))
    state, action = draw(PENDULUM, 6)
    compiled = torch.compile(model.transition, backend="eager", fullgraph=True)
    for one, other in zip(compiled(state, action), model.transition(state, action), strict=True):
        torch.testing.assert_close(one, other)


def test_bounded_and_fixed_constants_keep_their_limits():
    class Bounded(Pendulum):
        default_constants = {
            "gravity": Constant(9.81, fixed=True),
            "mass": Constant(1.0, low=0.5, high=2.0),
            "length": 1.0,
        }

    prior = PhysicsPrior(Bounded())
    drawn = prior.decode(prior.log_constants + 5.0 * torch.randn(100, 2))
    assert drawn["gravity"] == torch.tensor(9.81)
    assert drawn["mass"].shape == (100,)
    assert ((drawn["mass"] >= 0.5) & (drawn["mass"] <= 2.0)).all()
    assert (drawn["length"] > 0).all()


@pytest.mark.parametrize("shape", [(3,), (0, 3), (2, 4)])
def test_shifts_of_the_wrong_shape_are_named(shape):
    with pytest.raises(ConfigError, match=r"^shifts: expected a tensor of shape \[draws, 3\]"):
        per_life(HybridDynamics.hybrid(PENDULUM), torch.zeros(shape))


def test_shifts_without_learned_constants_are_refused():
    with pytest.raises(ConfigError, match=r"^shifts: expected none"):
        per_life(HybridDynamics.data_driven(PENDULUM), torch.zeros(2, 3))
