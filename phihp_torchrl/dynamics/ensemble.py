"""F^r as several networks, whose disagreement says where the data leave it open."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from phihp_torchrl.config import check_count
from phihp_torchrl.dynamics.residual import ResidualMLP
from phihp_torchrl.systems import System


class EnsembleResidual(ResidualMLP):
    """F^r as the mean of several networks that were fitted to different draws of the data.

    The members have the architecture and the scales of one :class:`ResidualMLP`, and other weights
    from the start. :func:`fit` fits the first with the prior to all transitions, and each other to
    a bootstrap draw of them. All are evaluated at once. (Chua et al., 2018,
    https://arxiv.org/abs/1805.12114, is such an ensemble without a prior.)

    Args:
        system: the system, whose states and actions the networks read.
        members: number of networks.
        hidden_sizes: as of :class:`ResidualMLP`.
        outputs: as of :class:`ResidualMLP`.
        activation: as of :class:`ResidualMLP`.

    Raises:
        ConfigError: if ``members`` is not a positive whole number, and as :class:`ResidualMLP`.

    Examples:
        >>> from phihp_torchrl.systems import Pendulum
        >>> residual = EnsembleResidual(Pendulum(), members=3)
        >>> state, action = torch.randn(8, 2), torch.randn(8, 1)
        >>> each = residual.each(state, action)
        >>> each.shape, torch.allclose(residual(state, action), each.mean(0))
        (torch.Size([3, 8, 2]), True)
    """

    network: _Stacked

    def __init__(
        self,
        system: System,
        members: int = 5,
        hidden_sizes: Sequence[int] = (16, 16),
        outputs: Sequence[int] | None = None,
        activation: type[nn.Module] = nn.Tanh,
    ) -> None:
        super().__init__(system, hidden_sizes, outputs, activation)
        self.members = members
        check_count(self, "members")
        others = [
            ResidualMLP(system, hidden_sizes, outputs, activation) for _ in range(members - 1)
        ]
        # The first network is the one that a single residual would have, with the same weights.
        networks: list[nn.Module] = [self.network, *(other.network for other in others)]
        self.network = _Stacked(networks, activation())

    @property
    def config(self) -> dict[str, Any]:
        """Plain values from which :meth:`from_config` builds it again, without the weights."""
        return {**super().config, "members": self.members}

    @classmethod
    def from_config(cls, system: System, config: Mapping[str, Any]) -> EnsembleResidual:
        """Build an untrained ensemble from :attr:`config`."""
        one = ResidualMLP.from_config(system, config)
        return cls(system, config["members"], one.hidden_sizes, one.outputs, one.activation)

    def each(self, state: Tensor, action: Tensor) -> Tensor:
        """F^r of every member: ``[*batch, n], [*batch, m] -> [members, *batch, n]``."""
        return super().forward(state, action)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """F^r, the mean of the members: ``[*batch, n], [*batch, m] -> [*batch, n]``."""
        return self.each(state, action).mean(0)

    @torch.no_grad()
    def member(self, index: int) -> ResidualMLP:
        """Return a copy of one member, scales included."""
        with torch.random.fork_rng(devices=[]):  # its first weights are drawn and thrown away
            one = ResidualMLP(self.system, self.hidden_sizes, self.outputs, self.activation)
        for mine, theirs in self._shared(index, one):
            theirs.copy_(mine)
        one.input_scale.copy_(self.input_scale)
        one.output_scale.copy_(self.output_scale)
        return one.to(self.input_scale.device)

    @torch.no_grad()
    def set_member(self, index: int, one: ResidualMLP) -> None:
        """Take the weights of ``one`` for a member; the scales stay those of all."""
        for mine, theirs in self._shared(index, one):
            mine.copy_(theirs)

    def _shared(self, index: int, one: ResidualMLP) -> list[tuple[Tensor, Tensor]]:
        """Each tensor of the member, and the one that it equals in a single network."""
        pairs = []
        for i, layer in enumerate(_layers(one.network)):
            pairs += [(self.network.weights[i][index], layer.weight.mT)]
            pairs += [(self.network.biases[i][index, 0], layer.bias)]
        return pairs


class _Stacked(nn.Module):
    """Networks of one architecture as one: ``[*batch, in] -> [networks, *batch, out]``."""

    def __init__(self, networks: Sequence[nn.Module], activation: nn.Module) -> None:
        super().__init__()
        layers = list(zip(*map(_layers, networks), strict=True))
        self.weights = nn.ParameterList(torch.stack([o.weight.mT for o in of]) for of in layers)
        self.biases = nn.ParameterList(torch.stack([o.bias[None] for o in of]) for of in layers)
        self.activation = activation

    def forward(self, inputs: Tensor) -> Tensor:
        batch = inputs.shape[:-1]
        values = inputs.reshape(1, -1, inputs.shape[-1]).expand(len(self.weights[0]), -1, -1)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            values = torch.baddbmm(bias, self.activation(values) if i else values, weight)
        return values.reshape(len(values), *batch, values.shape[-1])


def _layers(network: nn.Module) -> list[nn.Linear]:
    return [module for module in network.modules() if isinstance(module, nn.Linear)]
