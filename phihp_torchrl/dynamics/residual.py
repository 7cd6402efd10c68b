"""F^r as a module: a small network for the part of ds/dt that the prior leaves out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from phihp_torchrl.config import ConfigError, check_widths
from phihp_torchrl.systems import System

ACTIVATIONS = MappingProxyType(
    {kind.__name__: kind for kind in (nn.ReLU, nn.Tanh, nn.SiLU, nn.ELU, nn.GELU, nn.Softplus)}
)
"""Activations of a residual, by the name of their class."""
# Those that are faster to call as functions; a tanh is a sigmoid between changed layers.
_FUNCTIONS: dict[type[nn.Module], Any] = {nn.ReLU: torch.relu, nn.Tanh: torch.sigmoid}


class ResidualMLP(nn.Module):
    """F^r(s, a; theta_r): an MLP from observation and action to components of ds/dt.

    Angles enter as cosine and sine, so the residual is periodic in them. Inputs and outputs are
    scaled by buffers that :meth:`set_scales` sets from data. (Paper, section 4.1.)

    Args:
        system: the system, whose states and actions the network reads.
        hidden_sizes: widths of the hidden layers (paper: 2 x 16, Acrobots 3 x 16).
        outputs: indices of the components of ds/dt that the network changes; the others are zero.
            ``None`` means all of them, as in the paper.
        activation: class of the activation (paper: ReLU; tanh extrapolates more smoothly).

    Raises:
        ConfigError: for widths that are not positive whole numbers, an output that the system does
            not have, or an unknown activation.

    Examples:
        >>> from phihp_torchrl.systems import CartPole
        >>> residual = ResidualMLP(CartPole(), outputs=(1, 3))
        >>> residual(torch.randn(8, 4), torch.randn(8, 1))[:, 0].abs().max().item()
        0.0
    """

    input_scale: Tensor
    output_scale: Tensor

    def __init__(
        self,
        system: System,
        hidden_sizes: Sequence[int] = (16, 16),
        outputs: Sequence[int] | None = None,
        activation: type[nn.Module] = nn.Tanh,
    ) -> None:
        super().__init__()
        self.system = system
        self.hidden_sizes, self.activation = tuple(hidden_sizes), activation
        check_widths(self, "hidden_sizes")
        self.outputs = tuple(range(system.state_dim) if outputs is None else outputs)
        if not self.outputs or sorted(set(self.outputs) & set(range(system.state_dim))) != [
            *self.outputs
        ]:
            raise ConfigError(
                "outputs", f"expected some of {list(range(system.state_dim))}, got {self.outputs}."
            )
        if activation.__name__ not in ACTIVATIONS:
            raise ConfigError(
                "activation",
                f"expected one of {sorted(ACTIVATIONS)}, got {activation.__name__!r}.",
            )
        self.network = MLP(
            in_features=system.observation_dim + system.acting_dim,
            out_features=len(self.outputs),
            num_cells=list(hidden_sizes),
            activation_class=activation,
        )
        self.register_buffer("input_scale", torch.ones(system.observation_dim + system.acting_dim))
        self.register_buffer("output_scale", torch.ones(len(self.outputs)))

    @property
    def config(self) -> dict[str, Any]:
        """Plain values from which :meth:`from_config` builds it again, without the weights."""
        return {
            "hidden_sizes": list(self.hidden_sizes),
            "outputs": list(self.outputs),
            "activation": self.activation.__name__,
        }

    @classmethod
    def from_config(cls, system: System, config: Mapping[str, Any]) -> ResidualMLP:
        """Build an untrained residual from :attr:`config`."""
        name = config["activation"]
        if name not in ACTIVATIONS:
            raise ConfigError("activation", f"expected one of {sorted(ACTIVATIONS)}, got {name!r}.")
        return cls(system, config["hidden_sizes"], config["outputs"], ACTIVATIONS[name])

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """F^r: ``[*batch, n], [*batch, m] -> [*batch, n]``."""
        inputs = torch.cat([self.system.observe(state), action], -1) * self.input_scale
        return self._spread_out(self.network(inputs) * self.output_scale)

    def prepared(self) -> Callable[[Tensor, Tensor], Tensor] | None:
        """Return the same function of matrices, with scales and places as part of its layers.

        It is for states ``[rows, n]`` and actions ``[rows, m]`` without gradients, and reads the
        weights as they are now. ``None`` where the network or the system's observation is another
        than this class knows.
        """
        if type(self.system).observe is not System.observe:
            return None
        layers, between = list(self.network)[::2], list(self.network)[1::2]
        if not all(type(layer) is nn.Linear for layer in layers) or _watched(self.network):
            return None
        weights = [layer.weight.t() for layer in layers]
        biases = [layer.bias for layer in layers]
        weights[0] = self._from_features(self.input_scale[:, None] * weights[0])
        places = list(self.outputs)
        last = weights[-1].new_zeros(weights[-1].shape[0] + 1, self.system.state_dim)
        last[:-1, places] = weights[-1] * self.output_scale
        last[-1, places] = biases[-1] * self.output_scale
        weights[-1], biases[-1] = last[:-1], last[-1]
        called = [_FUNCTIONS.get(type(each), each) for each in between]
        for k, activation in enumerate(called):
            if activation is torch.sigmoid:
                _take_sigmoid(weights, biases, k)
        first = (weights[0], biases[0])
        rest = list(zip(called, weights[1:], biases[1:], strict=True))

        def residual(state: Tensor, action: Tensor) -> Tensor:
            # Fewer operations than to take the angles apart from the other components.
            features = torch.cat([state.cos(), state.sin(), state, action], -1)
            values = torch.addmm(first[1], features, first[0])
            for activation, weight, bias in rest:
                values = torch.addmm(bias, activation(values), weight)
            return values

        return residual

    def _from_features(self, weight: Tensor) -> Tensor:
        """The first layer for cosines, sines and values of all components, and the action."""
        system, n = self.system, self.system.state_dim
        columns = [*system.feature_columns(), *range(3 * n, 3 * n + system.acting_dim)]
        whole = weight.new_zeros(3 * n + system.acting_dim, weight.shape[1])
        whole[columns] = weight
        return whole

    def _spread_out(self, values: Tensor) -> Tensor:
        """Outputs ``[..., outputs]`` in their places among the components, ``[..., n]``."""
        columns = dict(zip(self.outputs, values.unbind(-1), strict=True))
        zero = torch.zeros_like(values[..., 0])
        return torch.stack([columns.get(i, zero) for i in range(self.system.state_dim)], -1)

    @torch.no_grad()
    def set_scales(self, state: Tensor, action: Tensor, derivative: Tensor) -> None:
        """Set the scales from transitions: inputs to unit size, outputs to that of ``derivative``.

        Args:
            state: states ``[N, n]``.
            action: actions ``[N, m]``.
            derivative: observed ds/dt ``[N, n]``.
        """
        inputs = torch.cat([self.system.observe(state), action], -1)
        self.input_scale.copy_(inputs.square().mean(0).sqrt().clamp_min(1e-3).reciprocal())
        self.output_scale.copy_(spread(derivative[:, list(self.outputs)]))


def _take_sigmoid(weights: list[Tensor], biases: list[Tensor], k: int) -> None:
    """Let a sigmoid after layer ``k`` do what a tanh did: tanh(z) = 2 sigmoid(2 z) - 1.

    On a CPU a sigmoid of a thousand rows takes a third of a tanh's time (``results/benchmarks``).
    """
    weights[k], biases[k] = 2.0 * weights[k], 2.0 * biases[k]
    biases[k + 1] = biases[k + 1] - weights[k + 1].sum(0)
    weights[k + 1] = 2.0 * weights[k + 1]


def spread(values: Tensor) -> Tensor:
    """Standard deviation ``[k]`` of the columns of ``values`` ``[N, k]``, at least 1e-3."""
    return values.std(0, correction=min(1, len(values) - 1)).clamp_min(1e-3)  # one row: zero


def _watched(module: nn.Module) -> bool:
    """Whether somebody follows the calls of a module or of its parts."""
    return any(part._forward_hooks or part._forward_pre_hooks for part in module.modules())
