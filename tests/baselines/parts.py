"""Systems of a few numbers whose best controllers are known."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Actuator, Box, Signal, Task


class Slider(System):
    """A mass without friction, pushed, and a second one that nothing pushes where ``loose``."""

    state_names, action_names = ("x", "x_dot"), ("force",)
    velocity_of = {"x": "x_dot"}
    default_constants = {"mass": 2.0, "load": 0.1}

    def prior(self, state: Tensor, action: Tensor, constants) -> Tensor:
        push = (action[..., 0] + constants["load"] - 0.1) / constants["mass"]
        return torch.stack([state[..., 1], push], -1)


class Tank(System):
    """A first-order level: it drains by a half of itself a second."""

    state_names, action_names = ("level",), ("inflow",)

    def prior(self, state: Tensor, action: Tensor, constants) -> Tensor:
        return 2.0 * action - 0.5 * state


class Leak(Tank):
    """A tank with a leak that the model does not know."""

    def prior(self, state: Tensor, action: Tensor, constants) -> Tensor:
        return super().prior(state, action, constants) - 1.0


class TwoTanks(System):
    """A tank that is filled through another one, so that the inflow reaches it late."""

    state_names, action_names = ("level", "upper"), ("inflow",)

    def prior(self, state: Tensor, action: Tensor, constants) -> Tensor:
        level, upper = state.unbind(-1)
        return torch.stack([2.0 * upper - 0.5 * level, action[..., 0] - 2.0 * upper], -1)


class Stray(Slider):
    """A slider beside a clock that grows by itself, which the force does not reach."""

    state_names = ("x", "x_dot", "drift")

    def prior(self, state: Tensor, action: Tensor, constants) -> Tensor:
        first = super().prior(state[..., :2], action, constants)
        return torch.cat([first, 0.3 * state[..., 2:]], -1)


def follow(state: Tensor, action: Tensor, next_state: Tensor, reference: Tensor) -> Tensor:
    return -(next_state[..., 0] - reference[..., 0]).square()


def squared(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
    return -(state.square().sum(-1) + 0.5 * action.square().sum(-1))


def task_of(system: System, actuator: Actuator | None = None, **options) -> Task:
    size = system.state_dim
    return Task(
        name="a-task-of-a-test",
        system=system,
        action_high=(5.0,) * system.action_dim,
        time_step=0.1,
        max_steps=200,
        reset=Box.around((0.0,) * size, (1.0,) * size),
        reward=squared,
        actuator=actuator,
        **options,
    )


def following(system: System, name: str = "level", **options) -> Task:
    """A task to keep a component at a reference between -1 and 3."""
    return replace(
        task_of(system), reward=follow, reference=Signal((name,), (-1.0,), (3.0,), **options)
    )


def prior_of(task: Task) -> HybridDynamics:
    return HybridDynamics.pure_prior(task)


def play(
    controller: nn.Module, task: Task, state: Tensor, steps: int, dynamics: nn.Module | None = None
) -> Tensor:
    """States ``[steps + 1, *batch, n]`` of a controller that reads observations in a model."""
    from tensordict import TensorDict

    model = TaskWorldModel(task, dynamics or prior_of(task))
    states = [state]
    with torch.no_grad():
        for k in range(steps):
            starts = torch.full([*state.shape[:-1], 1], k == 0)
            data = TensorDict(
                observation=model.observe(states[-1]), is_init=starts, batch_size=state.shape[:-1]
            )
            states.append(model.transition(states[-1], controller(data)["action"]).next_state)
    return torch.stack(states)
