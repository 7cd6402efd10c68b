"""F^r as a module: what it may change, its scales, and its settings."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from phihp_torchrl import get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import ACTIVATIONS, ResidualMLP
from phihp_torchrl.systems import Acrobot, CartPole, Pendulum
from phihp_torchrl.worlds import find_plant

from .draws import draw


def test_scales_make_inputs_and_outputs_of_unit_size():
    task = get_task("cartpole-swingup")
    residual = ResidualMLP(task.system, outputs=(1, 3))
    state, action = draw(task, 500)
    derivative = find_plant(task.system).derivative(state, action)
    residual.set_scales(state, action, derivative)
    inputs = torch.cat([task.observe(state), action], -1) * residual.input_scale
    torch.testing.assert_close(inputs.square().mean(0), torch.ones(inputs.shape[1]))
    torch.testing.assert_close(residual.output_scale, derivative[:, [1, 3]].std(0))


def test_scales_of_too_few_or_equal_transitions_are_finite():
    residual = ResidualMLP(Pendulum())
    for count in (1, 5):
        residual.set_scales(torch.zeros(count, 2), torch.zeros(count, 1), torch.zeros(count, 2))
        assert residual(torch.zeros(1, 2), torch.zeros(1, 1)).isfinite().all()


@pytest.mark.parametrize("outputs", [(0,), (1, 3), (0, 1, 2, 3), None])
def test_it_changes_its_outputs_alone(outputs):
    residual = ResidualMLP(CartPole(), outputs=outputs)
    values = residual(torch.randn(16, 4), torch.randn(16, 1))
    expected = set(range(4)) if outputs is None else set(outputs)
    assert {i for i in range(4) if (values[:, i] != 0).any()} == expected
    assert values.shape == (16, 4)


def test_full_turns_change_nothing():
    residual = ResidualMLP(Acrobot()).double()
    state, action = torch.randn(16, 4).double(), torch.randn(16, 2).double()
    turns = torch.tensor([2 * math.pi, -4 * math.pi, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(residual(state + turns, action), residual(state, action))


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_it_is_built_again_from_its_config_and_weights(name):
    one = ResidualMLP(CartPole(), (8, 4), (1, 3), ACTIVATIONS[name])
    state, action = torch.randn(16, 4), torch.randn(16, 1)
    one.set_scales(state, action, torch.randn(16, 4))
    assert one.config == {"hidden_sizes": [8, 4], "outputs": [1, 3], "activation": name}
    other = ResidualMLP.from_config(CartPole(), one.config)
    assert not torch.equal(other(state, action), one(state, action))
    other.load_state_dict(one.state_dict())
    assert torch.equal(other(state, action), one(state, action))


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"hidden_sizes": ()}, "hidden_sizes"),
        ({"hidden_sizes": (0,)}, "hidden_sizes"),
        ({"hidden_sizes": (8.5,)}, "hidden_sizes"),
        ({"outputs": ()}, "outputs"),
        ({"outputs": (4,)}, "outputs"),
        ({"outputs": (-1,)}, "outputs"),
        ({"outputs": (1, 1)}, "outputs"),
        ({"outputs": (3, 1)}, "outputs"),
        ({"activation": nn.Identity}, "activation"),
    ],
)
def test_what_it_cannot_be_is_named(options, key):
    with pytest.raises(ConfigError, match=f"^{key}: expected "):
        ResidualMLP(CartPole(), **options)


def test_an_unknown_activation_in_a_config_is_named():
    config = {**ResidualMLP(CartPole()).config, "activation": "Magic"}
    with pytest.raises(ConfigError, match=r"^activation: expected one of .*got 'Magic'"):
        ResidualMLP.from_config(CartPole(), config)
