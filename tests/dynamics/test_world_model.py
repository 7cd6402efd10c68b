"""A task and its dynamics as a world model: both of its interfaces, and what compiles."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from lopsided import LOPSIDED
from tensordict import TensorDict
from torch import nn

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.tasks import list_tasks
from phihp_torchrl.worlds import SimulatedWorld

from .draws import draw


@pytest.mark.parametrize("batch", [[], [4], [2, 3]])
@pytest.mark.parametrize("name", list_tasks())
def test_both_interfaces_agree(name, batch):
    task = get_task(name)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    state = (task.coverage or task.reset).sample(batch)
    action = 3 * torch.tensor(task.action_high) * torch.randn(*batch, task.action_dim)
    observation = model.observe(state)
    result = model(TensorDict(observation=observation, action=action, batch_size=batch))
    state = model.locate(observation)
    next_state, reward, terminated = model.transition(state, action)
    assert reward.shape == terminated.shape == torch.Size(batch)
    assert terminated.dtype == torch.bool
    assert torch.equal(result["state"], state)
    assert torch.equal(result["next", "state"], next_state)
    assert torch.equal(result["next", "reward"], reward.unsqueeze(-1))
    assert torch.equal(result["next", "terminated"], terminated.unsqueeze(-1))
    assert torch.equal(result["next", "observation"], model.observe(next_state))


@pytest.mark.parametrize("name", list_tasks())
def test_a_transition_is_the_tasks_by_the_models_step(name):
    task = get_task(name)
    dynamics = HybridDynamics.hybrid(task)
    model = TaskWorldModel(task, dynamics)
    state, action = draw(task)
    expected = task.transition(dynamics.step, state, 3 * action)
    for one, other in zip(model.transition(state, 3 * action), expected, strict=True):
        assert torch.equal(one, other)
    assert model.transitions is dynamics


@pytest.mark.parametrize("task", [get_task("acrobot"), LOPSIDED], ids=["acrobot", "lopsided"])
def test_splitting_a_batch_changes_nothing(task):
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    state, action = draw(task, 12)
    whole = model.transition(state, action)
    parts = [model.transition(s, a) for s, a in zip(state.split(5), action.split(5), strict=True)]
    for column, pieces in zip(whole, zip(*parts, strict=True), strict=True):
        torch.testing.assert_close(torch.cat(pieces), column)


def test_the_reward_is_of_the_clipped_action():
    task = get_task("pendulum")
    model = SimulatedWorld(task).model()
    _, reward, _ = model.transition(torch.zeros(1, 2), torch.full((1, 1), 50.0))
    assert reward.item() == pytest.approx(-0.001 * 2.0**2)
    model = SimulatedWorld(LOPSIDED).model()
    _, reward, _ = model.transition(torch.zeros(2, 2), torch.tensor([[50.0], [-50.0]]))
    assert reward.tolist() == pytest.approx([-0.001 * 12.0**2, -0.001 * 6.0**2])


def test_only_the_dynamics_are_learned():
    task = get_task("cartpole")
    dynamics = HybridDynamics.hybrid(task)
    ours = {id(parameter) for parameter in TaskWorldModel(task, dynamics).parameters()}
    assert ours == {id(parameter) for parameter in dynamics.parameters()}


def test_any_module_of_a_step_may_be_the_dynamics():
    class Drift(nn.Module):
        def forward(self, state, action):
            return state + action

    task = replace(get_task("pendulum"), velocity_limits={})
    model = TaskWorldModel(task, Drift())
    next_state, _, _ = model.transition(torch.zeros(2, 2), torch.tensor([[1.0], [5.0]]))
    assert next_state.tolist() == [[1.0, 1.0], [2.0, 2.0]], "the action is clipped by the task"
    assert model.compiles


@pytest.mark.parametrize(
    ("integrator", "compiles"), [("semi_implicit_euler", True), ("rk4", True), ("dopri5", False)]
)
def test_it_says_whether_it_compiles(integrator, compiles):
    task = get_task("pendulum")
    model = TaskWorldModel(task, HybridDynamics.pure_prior(task, integrator=integrator))
    assert model.compiles == compiles


def test_decode_reads_the_next_state_or_the_state():
    task = get_task("pendulum")
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    state = torch.tensor([[0.3, 1.0]])
    now = model.decode(TensorDict(state=state, batch_size=[1]))
    assert torch.equal(now["observation"], task.observe(state))
    following = TensorDict(next=TensorDict(state=state, batch_size=[1]), batch_size=[1])
    assert torch.equal(model.decode(following)["next", "observation"], task.observe(state))
    with pytest.raises(ValueError, match=r"^state: expected 'state' or \('next', 'state'\)"):
        model.decode(TensorDict(observation=task.observe(state), batch_size=[1]))
