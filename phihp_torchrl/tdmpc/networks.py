"""The task-oriented latent dynamics (TOLD) of TD-MPC: five small networks around a latent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torchrl.modules import MLP

from phihp_torchrl.config import ConfigError, check_count, check_fields
from phihp_torchrl.tasks import ActionBounds, Task

_WIDEST = 65_536
"""The largest width of a layer, so that a hostile file cannot ask for all memory."""


@dataclass(frozen=True)
class TOLDConfig:
    """Sizes of :class:`TOLD`, for observations of a state.

    Args:
        latent_dim: components of the latent.
        encoder_dim: width of the encoder's hidden layer.
        mlp_dim: width of both hidden layers of every other network.

    Raises:
        ConfigError: for a value out of range, by its name.
    """

    latent_dim: int = 50
    encoder_dim: int = 128
    mlp_dim: int = 128

    def __post_init__(self) -> None:
        check_fields(self)
        check_count(self, "latent_dim", "encoder_dim", "mlp_dim")
        for name, value in vars(self).items():
            if value > _WIDEST:
                raise ConfigError(name, f"expected at most {_WIDEST}, got {value}.")


class TOLD(nn.Module):
    r"""Encoder, latent dynamics, reward, twin Q and policy (Hansen et al., 2022, section 4).

    .. math::
        z_t = h(o_t), \quad z_{t+1} = d(z_t, a_t), \quad \hat r_t = R(z_t, a_t), \quad
        \hat q_t = Q_j(z_t, a_t), \quad \hat a_t = \pi(z_t)

    It has the methods of a model for planners (``locate``, ``observe``, ``transition``), in which
    the latent is both the state and the observation. Actions are in physical units; the networks
    read them scaled to [-1, 1].

    If episodes can terminate, a sixth network predicts from a latent whether they have. The
    publication has no terminations.

    The weights start orthogonal and the biases at zero; the last layers of reward and Q are zero.

    References: https://arxiv.org/abs/2203.04955.

    Args:
        observation_dim: components of an observation, ``o``.
        bounds: bounds of the action in physical units, ``[m]``.
        config: sizes.
        terminates: whether episodes can terminate.

    Examples:
        >>> told = TOLD(3, ActionBounds.from_limits([-2.0], [2.0]))
        >>> latent = told.encode(torch.zeros(8, 3))
        >>> next_latent, reward, terminated = told.transition(latent, torch.zeros(8, 1))
        >>> next_latent.shape, reward.shape
        (torch.Size([8, 50]), torch.Size([8]))
        >>> told.q_values(latent, told.policy(latent)).shape
        torch.Size([2, 8])
    """

    low: Tensor
    high: Tensor
    center: Tensor
    scale: Tensor

    def __init__(
        self,
        observation_dim: int,
        bounds: ActionBounds,
        config: TOLDConfig | None = None,
        *,
        terminates: bool = False,
    ) -> None:
        super().__init__()
        self.config = config = config or TOLDConfig()
        latent, action = config.latent_dim, len(bounds.scale)
        self.encoder = _mlp(observation_dim, latent, [config.encoder_dim])
        hidden = [config.mlp_dim] * 2
        self.dynamics = _mlp(latent + action, latent, hidden)
        self.reward = _mlp(latent + action, 1, hidden)
        self.critics = nn.ModuleList(_critic(latent + action, config.mlp_dim) for _ in range(2))
        self.actor = _mlp(latent, action, hidden)
        self.termination = _mlp(latent, 1, hidden) if terminates else None
        for name, limit in bounds._asdict().items():  # the task's, and no part of the weights
            self.register_buffer(name, limit, persistent=False)
        self.apply(_orthogonal)
        for network in (self.reward, *self.critics):
            nn.init.zeros_(network[-1].weight)

    @classmethod
    def for_task(cls, task: Task, config: TOLDConfig | None = None) -> TOLD:
        """The networks that a task wants, untrained."""
        return cls(
            task.observation_dim,
            task.bounds,
            config,
            terminates=task.terminated is not None or task.limits.ends_episodes,
        )

    @property
    def bounds(self) -> ActionBounds:
        """The action's bounds, where the networks are."""
        return ActionBounds(self.low, self.high, self.center, self.scale)

    def encode(self, observation: Tensor) -> Tensor:
        """Observation ``[*batch, o]`` -> latent ``[*batch, l]``."""
        return self.encoder(observation)

    def predict(self, latent: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Next latent ``[*batch, l]`` and reward ``[*batch]``."""
        inputs = self._inputs(latent, action)
        return self.dynamics(inputs), self.reward(inputs).squeeze(-1)

    def q_values(self, latent: Tensor, action: Tensor, *, held: bool = False) -> Tensor:
        """The values of both critics, ``[2, *batch]``.

        Args:
            latent: ``[*batch, l]``.
            action: physical units, ``[*batch, m]``.
            held: whether to keep gradients from the critics' own parameters.
        """
        inputs = self._inputs(latent, action)
        values = (_call_held(c, inputs) if held else c(inputs) for c in self.critics)
        return torch.stack([value.squeeze(-1) for value in values])

    def twin_values(self, latent: Tensor, action: Tensor) -> Tensor:
        """The same ``[*batch, 2]``, as planners take them."""
        return self.q_values(latent, action).movedim(0, -1)

    def policy(self, latent: Tensor, noise: Tensor | None = None) -> Tensor:
        """The policy's action ``[*batch, m]``.

        Args:
            latent: ``[*batch, l]``.
            noise: added to the action, in units of its half-range, ``[*batch, m]``.
        """
        return self.squash(self.actor(latent), noise)

    def squash(self, output: Tensor, noise: Tensor | None = None) -> Tensor:
        """The action that an output of the actor's network ``[*batch, m]`` stands for.

        Gradients pass the clipping of noisy actions as if it were not there, as published.
        """
        action = output.tanh()
        if noise is not None:
            clipped = (action + noise).clamp(-1.0, 1.0)
            action = clipped.detach() + (action - action.detach())
        return self.bounds.from_unit(action)

    def termination_logit(self, latent: Tensor) -> Tensor | None:
        """Logit ``[*batch]`` of having terminated in ``latent``; ``None`` if that never happens."""
        return None if self.termination is None else self.termination(latent).squeeze(-1)

    # The model of a planner.

    def locate(self, observation: Tensor) -> Tensor:
        """The latent is what a planner observes."""
        return observation

    def observe(self, state: Tensor) -> Tensor:
        """The latent is what actor and critics read."""
        return state

    def transition(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Next latent ``[*batch, l]``, reward and (bool) terminated, each ``[*batch]``."""
        next_latent, reward = self.predict(state, action)
        logit = self.termination_logit(next_latent)
        terminated = torch.zeros_like(reward, dtype=torch.bool) if logit is None else logit > 0
        return next_latent, reward, terminated

    def _inputs(self, latent: Tensor, action: Tensor) -> Tensor:
        return torch.cat([latent, self.bounds.to_unit(action)], -1)


def _mlp(in_features: int, out_features: int, hidden: Sequence[int]) -> MLP:
    return MLP(in_features, out_features, num_cells=list(hidden), activation_class=nn.ELU)


def _critic(in_features: int, width: int) -> nn.Sequential:
    """A critic: its first layer is normalised, and squashed by tanh (publication, appendix)."""
    return nn.Sequential(
        nn.Linear(in_features, width),
        nn.LayerNorm(width),
        nn.Tanh(),
        nn.Linear(width, width),
        nn.ELU(),
        nn.Linear(width, 1),
    )


def _call_held(network: nn.Module, inputs: Tensor) -> Tensor:
    parameters = {name: p.detach() for name, p in network.named_parameters()}
    return functional_call(network, parameters, (inputs,))


def _orthogonal(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.orthogonal_(module.weight)
        nn.init.zeros_(module.bias)
