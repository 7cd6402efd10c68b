"""Gradients by the tape and inside a graph: the same as torch.func's, to the last bit."""

from __future__ import annotations

import pytest
import torch

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import TD3Config, TD3Update, make_td3_loss
from phihp_torchrl.agents.equations import actor_loss, critic_loss
from phihp_torchrl.agents.gradients import grad_and_value
from phihp_torchrl.dynamics import TaskWorldModel


def losses():
    """Both losses of TD3, as ``loss, layers, further arguments``."""
    task = get_task("cartpole-swingup")
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    config = TD3Config(actor_hidden_sizes=(16, 16), critic_hidden_sizes=(16, 16))
    nets = TD3Update(make_td3_loss(model, config), model, config).networks
    observation = task.observe(task.coverage.sample([32]))
    action, target = torch.rand(32, task.action_dim), torch.randn(32)
    return [
        (critic_loss, nets.critics, (observation, action, target, task.bounds)),
        (actor_loss, nets.actor, (nets.critics, observation, task.bounds)),
    ]


@pytest.mark.parametrize("which", [0, 1], ids=["critics", "actor"])
@torch.no_grad()
def test_they_are_those_of_torch_func_to_the_bit(which):
    loss, layers, args = losses()[which]
    before = [layer.clone() for layer in layers]
    slopes, value = grad_and_value(loss, layers, *args)
    expected, score = torch.func.grad_and_value(loss)(layers, *args)
    assert torch.equal(value, score)
    assert all(map(torch.equal, slopes, expected))
    assert any(slope.abs().sum() > 0 for slope in slopes)
    assert all(map(torch.equal, layers, before))
    assert not any(tensor.requires_grad for tensor in (value, *slopes))


def test_a_layer_without_effect_has_slopes_of_zero():
    slopes, _ = grad_and_value(lambda layers: layers[0].sum(), [torch.ones(2), torch.ones(3)])
    assert torch.equal(slopes[1], torch.zeros(3))


@torch.no_grad()
def test_a_compiler_takes_them_whole():
    loss, layers, args = losses()[0]
    graph = torch.compile(grad_and_value, fullgraph=True, backend="eager")
    for one, other in zip(
        graph(loss, layers, *args)[0], grad_and_value(loss, layers, *args)[0], strict=True
    ):
        torch.testing.assert_close(one, other)
