"""Actor and critics as modules (paper, section 4.2 and its table of hyper-parameters)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP

from phihp_torchrl.agents.equations import Layers, prepare, q_values
from phihp_torchrl.config import ConfigError, check_widths
from phihp_torchrl.tasks import ActionBounds, Task

N = TypeVar("N", bound="_Network")


class _Network(nn.Module):
    """The base of actor and critics: sizes, bounds of the action, and their description.

    The bounds are buffers that are not saved with the weights, because the task defines them.
    """

    kind: ClassVar[str]
    low: Tensor
    high: Tensor
    center: Tensor
    scale: Tensor

    def __init__(self, task: Task, hidden_sizes: Sequence[int]) -> None:
        super().__init__()
        self.hidden_sizes = tuple(hidden_sizes)
        check_widths(self, "hidden_sizes")
        for name, limit in task.bounds._asdict().items():
            self.register_buffer(name, limit, persistent=False)

    @property
    def bounds(self) -> ActionBounds:
        """The bounds of the action, on the device of the network."""
        return ActionBounds(self.low, self.high, self.center, self.scale)

    @property
    def config(self) -> dict[str, Any]:
        """Plain values from which :meth:`from_config` builds it again, without the weights."""
        return {"kind": self.kind, "hidden_sizes": list(self.hidden_sizes)}

    @classmethod
    def from_config(cls: type[N], task: Task, config: Mapping[str, Any]) -> N:
        """Build an untrained network from :attr:`config`.

        Raises:
            ConfigError: for a config of another kind of network.
        """
        if config["kind"] != cls.kind:
            raise ConfigError("kind", f"expected {cls.kind!r}, got {config['kind']!r}.")
        return cls(task, config["hidden_sizes"])


class Actor(_Network):
    """The actor, a deterministic policy: observation ``[*batch, o]`` to action ``[*batch, m]``.

    Actions are in physical units and in bounds.

    Args:
        task: the task, which has the sizes and the bounds of the action.
        hidden_sizes: widths of the hidden layers (paper: 2 x 300, ReLU).
        last_layer_scale: factor on the initial weights of the last layer. With a small one the
            first actions are near the middle of the bounds, where tanh is not saturated.

    Raises:
        ConfigError: for widths that are not positive whole numbers.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> Actor(get_task("acrobot-swingup"))(torch.zeros(5, 6)).shape
        torch.Size([5, 2])
    """

    kind = "mlp_actor"

    def __init__(
        self, task: Task, hidden_sizes: Sequence[int] = (300, 300), last_layer_scale: float = 1.0
    ) -> None:
        super().__init__(task, hidden_sizes)
        self.mlp = MLP(
            in_features=task.observation_dim,
            out_features=task.action_dim,
            num_cells=list(hidden_sizes),
            activation_class=nn.ReLU,
        )
        with torch.no_grad():
            self.mlp[-1].weight.mul_(last_layer_scale)
            self.mlp[-1].bias.mul_(last_layer_scale)

    def forward(self, observation: Tensor) -> Tensor:
        return self.bounds.from_unit(self.mlp(observation).tanh())

    def evaluate(self, observation: Tensor) -> Tensor | None:
        """The action for one observation ``[o]``, without gradients and calls of modules.

        These calls take longer than the layers. ``None`` for a batch, under autocast, for other
        layers, and where hooks follow the calls: then call the module.
        """
        mlp = self.mlp
        if (
            observation.ndim != 1
            or type(self).forward is not Actor.forward
            or torch.is_autocast_enabled(observation.device.type)
            or _is_followed(self)
            or _is_followed(mlp)
        ):
            return None
        values = observation
        for part in mlp._modules.values():
            if part is None or _is_followed(part):
                return None
            if type(part) is nn.Linear:
                layer = part._parameters
                values = torch.addmv(layer["bias"], layer["weight"], values)  # type: ignore[arg-type]
            elif type(part) is nn.ReLU:
                values = values.relu_()
            else:
                return None
        return torch.addcmul(self.center, self.scale, values.tanh())

    def prepared(self) -> Callable[[Tensor], Tensor]:
        """Return the same function without calls of modules, which take as long as small layers.

        It reads weights that are changed in place, but not parameters that take their place.
        """
        if type(self).forward is not Actor.forward or not _is_plain(self.mlp):
            return self
        network, bounds = prepare(list(self.mlp.parameters())), self.bounds
        return lambda observation: bounds.from_unit(network(observation).tanh())

    @classmethod
    def from_layers(cls, task: Task, layers: Layers) -> Actor:
        """Build an actor with copies of the layers ``(weight, bias, …)`` that TD3 trains."""
        actor = cls(task, [weight.shape[0] for weight in layers[:-2:2]])
        _copy_layers(list(actor.mlp.parameters()), layers)
        return actor


class QNetwork(_Network):
    """One critic: observation ``[*batch, o]`` and action ``[*batch, m]`` to value ``[*batch, 1]``.

    Actions are in physical units; the network reads them scaled to [-1, 1].

    Args:
        task: the task, which has the sizes and the bounds of the action.
        hidden_sizes: widths of the hidden layers (paper: 3 x 200, ReLU).

    Raises:
        ConfigError: for widths that are not positive whole numbers.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> QNetwork(get_task("pendulum"))(torch.zeros(5, 3), torch.zeros(5, 1)).shape
        torch.Size([5, 1])
    """

    kind = "mlp_critic"

    def __init__(self, task: Task, hidden_sizes: Sequence[int] = (200, 200, 200)) -> None:
        super().__init__(task, hidden_sizes)
        self.mlp = MLP(
            in_features=task.observation_dim + task.action_dim,
            out_features=1,
            num_cells=list(hidden_sizes),
            activation_class=nn.ReLU,
        )

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.mlp(torch.cat([observation, self.bounds.to_unit(action)], -1))


class TwinQ(_Network):
    """Both critics of TD3 in one module: observation and action to values ``[*batch, 2]``.

    Actions are in physical units. The layers are stacked ``[2, out, in]``, as
    :class:`torchrl.objectives.TD3Loss` stacks those of two :class:`QNetwork`.

    Args:
        task: the task, which has the sizes and the bounds of the action.
        hidden_sizes: widths of the hidden layers of each critic (paper: 3 x 200, ReLU).

    Raises:
        ConfigError: for widths that are not positive whole numbers.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> TwinQ(get_task("pendulum"))(torch.zeros(5, 4, 3), torch.zeros(5, 4, 1)).shape
        torch.Size([5, 4, 2])
    """

    kind = "twin_q"

    def __init__(self, task: Task, hidden_sizes: Sequence[int] = (200, 200, 200)) -> None:
        super().__init__(task, hidden_sizes)
        critics = [QNetwork(task, hidden_sizes) for _ in range(2)]
        columns = zip(*(critic.mlp.parameters() for critic in critics), strict=True)
        self.layers = nn.ParameterList(torch.stack(column).detach() for column in columns)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        batch = observation.shape[:-1]
        values = q_values(
            list(self.layers),
            observation.reshape(-1, observation.shape[-1]),
            action.reshape(-1, action.shape[-1]),
            self.bounds,
        )
        return values.mT.reshape(*batch, -1)

    def prepared(self) -> Callable[[Tensor, Tensor], Tensor]:
        """Return the same function of matrices, without the calls of modules.

        It reads weights that are changed in place, but not parameters that take their place.
        """
        if type(self).forward is not TwinQ.forward:
            return self
        # One critic at a time: batched products of 64 rows and more take longer.
        columns = [layer.unbind() for layer in self.layers]
        critics = [prepare(layers) for layers in zip(*columns, strict=True)]
        bounds = self.bounds

        def values(observation: Tensor, action: Tensor) -> Tensor:
            inputs = torch.cat([observation, bounds.to_unit(action)], -1)
            return torch.cat([critic(inputs) for critic in critics], -1)

        return values

    @classmethod
    def from_layers(cls, task: Task, layers: Layers) -> TwinQ:
        """Build critics with copies of the stacked layers ``(weight, bias, …)`` that TD3 trains."""
        critics = cls(task, [weight.shape[1] for weight in layers[:-2:2]])
        _copy_layers(list(critics.layers), layers)
        return critics


def _is_plain(network: nn.Sequential) -> bool:
    """Whether a network is linear layers with ReLU between them, and nobody follows its calls."""
    kinds = [nn.Linear, nn.ReLU] * len(network)
    alike = all(type(part) is kind for part, kind in zip(network, kinds, strict=False))
    return alike and not any(map(_is_followed, network.modules()))


def _is_followed(module: nn.Module) -> bool:
    """Whether hooks follow the calls of a module; those of its parts are not asked."""
    return bool(module._forward_hooks or module._forward_pre_hooks)


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
    """Make an actor as a TensorDict module, which reads ``"observation"`` and writes ``"action"``.

    Args:
        task: the task, which has the sizes and the bounds of the action.
        hidden_sizes: widths of the hidden layers.
        last_layer_scale: factor on the initial weights of the last layer.

    Raises:
        ConfigError: for widths that are not positive whole numbers.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> actor = make_actor(get_task("pendulum"), hidden_sizes=(8,))
        >>> actor(TensorDict(observation=torch.zeros(5, 3), batch_size=[5]))["action"].shape
        torch.Size([5, 1])
    """
    return TensorDictModule(
        Actor(task, hidden_sizes, last_layer_scale), ["observation"], ["action"]
    )


def make_qvalue(task: Task, hidden_sizes: Sequence[int] = (200, 200, 200)) -> TensorDictModule:
    """Make one critic as a TensorDict module, for :class:`torchrl.objectives.TD3Loss`.

    Args:
        task: the task, which has the sizes and the bounds of the action.
        hidden_sizes: widths of the hidden layers.

    Raises:
        ConfigError: for widths that are not positive whole numbers.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> qvalue = make_qvalue(get_task("pendulum"), hidden_sizes=(8,))
        >>> data = TensorDict(
        ...     observation=torch.zeros(5, 3), action=torch.zeros(5, 1), batch_size=[5]
        ... )
        >>> qvalue(data)["state_action_value"].shape
        torch.Size([5, 1])
    """
    return TensorDictModule(
        QNetwork(task, hidden_sizes), ["observation", "action"], ["state_action_value"]
    )


def make_twin_qvalue(task: Task, hidden_sizes: Sequence[int] = (200, 200, 200)) -> TensorDictModule:
    """Make both critics as one TensorDict module that writes ``[*batch, 2]``, for planners.

    Args:
        task: the task, which has the sizes and the bounds of the action.
        hidden_sizes: widths of the hidden layers of each critic.

    Raises:
        ConfigError: for widths that are not positive whole numbers.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> qvalue = make_twin_qvalue(get_task("pendulum"), hidden_sizes=(8,))
        >>> data = TensorDict(
        ...     observation=torch.zeros(5, 3), action=torch.zeros(5, 1), batch_size=[5]
        ... )
        >>> qvalue(data)["state_action_value"].shape
        torch.Size([5, 2])
    """
    return TensorDictModule(
        TwinQ(task, hidden_sizes), ["observation", "action"], ["state_action_value"]
    )


def copy_actor(task: Task, layers: Layers) -> TensorDictModule:
    """Make an actor with copies of the layers that TD3 trains, as :func:`make_actor` does."""
    return TensorDictModule(Actor.from_layers(task, layers), ["observation"], ["action"])


def copy_twin_qvalue(task: Task, layers: Layers) -> TensorDictModule:
    """Make critics with copies of the layers that TD3 trains, as :func:`make_twin_qvalue` does."""
    critics = TwinQ.from_layers(task, layers)
    return TensorDictModule(critics, ["observation", "action"], ["state_action_value"])
