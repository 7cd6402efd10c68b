"""Actor and critics as modules (SPEC section 3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP

from phihp_torchrl.agents.functional import Layers, q_values
from phihp_torchrl.tasks import Task


class Actor(nn.Module):
    """A deterministic policy: observation ``[*batch, o]`` -> physical action ``[*batch, m]``.

    Args:
        task: gives the sizes and the action bounds.
        hidden_sizes: widths of the hidden layers (paper: 2 x 300, ReLU).
        last_layer_scale: factor on the last layer's initial weights. A small one starts the policy
            near zero torque, away from the flat ends of tanh.
    """

    action_high: Tensor

    def __init__(
        self, task: Task, hidden_sizes: Sequence[int] = (300, 300), last_layer_scale: float = 1.0
    ) -> None:
        super().__init__()
        self.mlp = MLP(
            in_features=task.system.observation_dim,
            out_features=task.system.action_dim,
            num_cells=list(hidden_sizes),
            activation_class=nn.ReLU,
        )
        with torch.no_grad():
            self.mlp[-1].weight.mul_(last_layer_scale)
            self.mlp[-1].bias.mul_(last_layer_scale)
        self.register_buffer("action_high", torch.tensor(task.action_high))

    def forward(self, observation: Tensor) -> Tensor:
        return self.mlp(observation).tanh() * self.action_high

    @classmethod
    def from_layers(cls, task: Task, layers: Layers) -> Actor:
        """An actor with copies of the layers ``(weight, bias, …)``, as TD3 trains them."""
        actor = cls(task, [weight.shape[0] for weight in layers[:-2:2]])
        _copy_layers(list(actor.mlp.parameters()), layers)
        return actor


class QNetwork(nn.Module):
    """One critic: observation, action in physical units -> value ``[*batch, 1]``.

    It sees the action scaled to [-1, 1].

    Args:
        task: gives the sizes and the action bounds.
        hidden_sizes: widths of the hidden layers (paper: 3 x 200, ReLU).
    """

    action_high: Tensor

    def __init__(self, task: Task, hidden_sizes: Sequence[int] = (200, 200, 200)) -> None:
        super().__init__()
        self.mlp = MLP(
            in_features=task.system.observation_dim + task.system.action_dim,
            out_features=1,
            num_cells=list(hidden_sizes),
            activation_class=nn.ReLU,
        )
        self.register_buffer("action_high", torch.tensor(task.action_high))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.mlp(torch.cat([observation, action / self.action_high], -1))


class TwinQ(nn.Module):
    """Both critics at once: observation, action in physical units -> values ``[*batch, 2]``.

    The layers are stacked ``[2, out, in]``, as :class:`torchrl.objectives.TD3Loss` stacks those of
    two :class:`QNetwork`, and evaluated by :func:`~phihp_torchrl.agents.functional.q_values`.

    Args:
        task: gives the sizes and the action bounds.
        hidden_sizes: widths of the hidden layers of each critic (paper: 3 x 200, ReLU).

    Examples:
        >>> from phihp_torchrl import get_task
        >>> TwinQ(get_task("pendulum"))(torch.zeros(5, 4, 3), torch.zeros(5, 4, 1)).shape
        torch.Size([5, 4, 2])
    """

    action_high: Tensor

    def __init__(self, task: Task, hidden_sizes: Sequence[int] = (200, 200, 200)) -> None:
        super().__init__()
        critics = [QNetwork(task, hidden_sizes) for _ in range(2)]
        columns = zip(*(critic.mlp.parameters() for critic in critics), strict=True)
        self.layers = nn.ParameterList(torch.stack(column).detach() for column in columns)
        self.register_buffer("action_high", torch.tensor(task.action_high))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        batch = observation.shape[:-1]
        values = q_values(
            list(self.layers),
            observation.reshape(-1, observation.shape[-1]),
            action.reshape(-1, action.shape[-1]),
            self.action_high,
        )
        return values.mT.reshape(*batch, -1)

    @classmethod
    def from_layers(cls, task: Task, layers: Layers) -> TwinQ:
        """Critics with copies of the stacked layers ``(weight, bias, …)``, as TD3 trains them."""
        critics = cls(task, [weight.shape[1] for weight in layers[:-2:2]])
        _copy_layers(list(critics.layers), layers)
        return critics


@torch.no_grad()
def _copy_layers(params: Layers, layers: Layers) -> None:
    for param, layer in zip(params, layers, strict=True):
        if param.shape != layer.shape:
            raise ValueError(
                f"layers: expected shape {list(param.shape)}, got {list(layer.shape)}; "
                "are they those of this task?"
            )
        param.copy_(layer)


def make_actor(
    task: Task, hidden_sizes: Sequence[int] = (300, 300), last_layer_scale: float = 1.0
) -> TensorDictModule:
    """The actor as a TensorDict module, ``"observation"`` -> ``"action"``."""
    return TensorDictModule(
        Actor(task, hidden_sizes, last_layer_scale), ["observation"], ["action"]
    )


def make_qvalue(task: Task, hidden_sizes: Sequence[int] = (200, 200, 200)) -> TensorDictModule:
    """One critic as a TensorDict module, as :class:`torchrl.objectives.TD3Loss` takes it."""
    return TensorDictModule(
        QNetwork(task, hidden_sizes), ["observation", "action"], ["state_action_value"]
    )


def make_twin_qvalue(task: Task, hidden_sizes: Sequence[int] = (200, 200, 200)) -> TensorDictModule:
    """Both critics as a TensorDict module that writes ``[*batch, 2]``, as planners take it."""
    return TensorDictModule(
        TwinQ(task, hidden_sizes), ["observation", "action"], ["state_action_value"]
    )


def copy_actor(task: Task, layers: Layers) -> TensorDictModule:
    """An actor with copies of the layers that TD3 trains, ``"observation"`` -> ``"action"``."""
    return TensorDictModule(Actor.from_layers(task, layers), ["observation"], ["action"])


def copy_twin_qvalue(task: Task, layers: Layers) -> TensorDictModule:
    """Both critics with copies of the layers that TD3 trains, as planners take them."""
    critics = TwinQ.from_layers(task, layers)
    return TensorDictModule(critics, ["observation", "action"], ["state_action_value"])
