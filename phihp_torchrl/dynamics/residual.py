"""F^r as a module: a small network for what the prior leaves out."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from phihp_torchrl.systems import System


class ResidualMLP(nn.Module):
    """F^r(s, a; theta_r): an MLP from the observed state and the action to a part of ds/dt.

    Angles enter as cosine and sine, so the residual is periodic as the world is. Inputs and outputs
    are scaled by buffers that :meth:`set_scales` fits to data.

    Args:
        system: whose state and action these are.
        hidden_sizes: widths of the hidden layers (paper: 2 x 16, Acrobots 3 x 16).
        outputs: indices of the components of ds/dt that the network may change; the others get
            zero. ``None`` means all of them, as in the paper.
        activation: class of the activation (paper: ReLU).

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
        activation: type[nn.Module] = nn.ReLU,
    ) -> None:
        super().__init__()
        if not hidden_sizes or any(size < 1 for size in hidden_sizes):
            raise ValueError(f"hidden_sizes: expected positive widths, got {tuple(hidden_sizes)}.")
        self.system = system
        self.outputs = tuple(range(system.state_dim) if outputs is None else outputs)
        self.network = MLP(
            in_features=system.observation_dim + system.action_dim,
            out_features=len(self.outputs),
            num_cells=list(hidden_sizes),
            activation_class=activation,
        )
        self.register_buffer("input_scale", torch.ones(system.observation_dim + system.action_dim))
        self.register_buffer("output_scale", torch.ones(len(self.outputs)))

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """F^r: ``[*batch, n], [*batch, m] -> [*batch, n]``."""
        inputs = torch.cat([self.system.observe(state), action], -1) * self.input_scale
        values = (self.network(inputs) * self.output_scale).unbind(-1)
        zero = torch.zeros_like(state[..., 0])
        columns = dict(zip(self.outputs, values, strict=True))
        return torch.stack([columns.get(i, zero) for i in range(self.system.state_dim)], -1)

    @torch.no_grad()
    def set_scales(self, state: Tensor, action: Tensor, derivative: Tensor) -> None:
        """Fit the scales to transitions: inputs to unit size, outputs to that of ``derivative``.

        Args:
            state: states ``[N, n]``.
            action: actions ``[N, m]``.
            derivative: observed ds/dt ``[N, n]``.
        """
        inputs = torch.cat([self.system.observe(state), action], -1)
        self.input_scale.copy_(inputs.square().mean(0).sqrt().clamp_min(1e-3).reciprocal())
        self.output_scale.copy_(spread(derivative[:, list(self.outputs)]))


def spread(values: Tensor) -> Tensor:
    """Standard deviation ``[k]`` of the columns of ``values`` ``[N, k]``, at least 1e-3."""
    return values.std(0, correction=min(1, len(values) - 1)).clamp_min(1e-3)  # of one row, zero
