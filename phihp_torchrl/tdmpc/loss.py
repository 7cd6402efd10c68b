"""TD-MPC's losses as a TorchRL loss module."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import LossModule

from phihp_torchrl.agents import soft_update_
from phihp_torchrl.compilation import compile_graph
from phihp_torchrl.config import (
    Discount,
    check_discount,
    check_fields,
    check_not_negative,
    check_positive_share,
)
from phihp_torchrl.tdmpc.equations import (
    ModelLosses,
    Slices,
    model_losses,
    policy_loss,
    td_target,
)
from phihp_torchrl.tdmpc.networks import TOLD

_NOISE_CLIP = 0.3
"""Largest noise on the policy's actions in the published runs, in units of the half-range."""


@dataclass(frozen=True)
class TDMPCLossConfig:
    """Weights of the losses of TD-MPC.

    Args:
        gamma: discount γ, or its time constant, such as "5 s".
        rho: weight ρ of a step relative to the one before.
        consistency_coef: weight of the error of the latent.
        reward_coef: weight of the error of the reward.
        value_coef: weight of the error of the critics.
        termination_coef: weight of the error of the termination, if episodes can terminate.
        policy_noise: std of the noise on the policy's actions in the losses, in units of the
            action's half-range.
        output_penalty: weight of the policy's squared outputs before tanh, which keeps tanh from
            saturating.

    Raises:
        ConfigError: for a value out of range; the message names the field.
    """

    gamma: Discount = 0.99
    rho: float = 0.5
    consistency_coef: float = 2.0
    reward_coef: float = 0.5
    value_coef: float = 0.1
    termination_coef: float = 0.5
    policy_noise: float = 0.05
    output_penalty: float = 0.005

    def __post_init__(self) -> None:
        check_fields(self)
        check_discount(self, "gamma")
        check_positive_share(self, "rho")
        coefficients = [f"{name}_coef" for name in ("consistency", "reward", "value")]
        check_not_negative(
            self, *coefficients, "termination_coef", "policy_noise", "output_penalty"
        )


class TDMPCLoss(LossModule):
    r"""The losses of model, critics and policy on slices of episodes.

    .. math::
        L_{model} = \frac{1}{N H} \sum_n w_n (c_1 L_{consistency} + c_2 L_{reward} + c_3 L_{value}
        + c_4 L_{termination}), \qquad L_{policy}

    with the terms of :func:`~phihp_torchrl.tdmpc.equations.model_losses` and
    :func:`~phihp_torchrl.tdmpc.equations.policy_loss`, and the importance weights :math:`w_n`
    of prioritized replay. Both may be summed and differentiated at once, for they share no
    gradients: ``loss_model`` reaches all but the policy, ``loss_policy`` the policy alone.

    It reads tensordicts of batch size ``[N, H]``.

    References: https://arxiv.org/abs/2203.04955.

    Args:
        told: the networks to train.
        config: weights of the losses.
        compile: whether to compile losses and gradients (about a minute at first).

    Examples:
        >>> from phihp_torchrl.tasks import ActionBounds
        >>> told = TOLD(3, ActionBounds.from_limits([-2.0], [2.0]))
        >>> slices = TensorDict(
        ...     observation=torch.zeros(8, 5, 3),
        ...     action=torch.zeros(8, 5, 1),
        ...     valid=torch.ones(8, 5, dtype=torch.bool),
        ...     next=TensorDict(
        ...         observation=torch.zeros(8, 5, 3),
        ...         reward=torch.ones(8, 5, 1),
        ...         terminated=torch.zeros(8, 5, 1, dtype=torch.bool),
        ...         batch_size=[8, 5],
        ...     ),
        ...     batch_size=[8, 5],
        ... )
        >>> losses = TDMPCLoss(told, TDMPCLossConfig())(slices)
        >>> losses["td_error"].shape, losses["loss_reward"].item() > 0
        (torch.Size([8]), True)
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set with ``set_keys``; the first, and what a step left, under "next"."""

        observation: NestedKey = "observation"
        action: NestedKey = "action"
        reward: NestedKey = "reward"
        terminated: NestedKey = "terminated"
        valid: NestedKey = "valid"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = [
        "loss_model",
        "loss_policy",
        "loss_consistency",
        "loss_reward",
        "loss_value",
        "loss_termination",
        "td_error",
    ]

    told: TOLD

    def __init__(self, told: TOLD, config: TDMPCLossConfig, *, compile: bool = False) -> None:
        super().__init__()
        self.told = told
        self.target = copy.deepcopy(told).requires_grad_(False)
        self.config = config
        self._core = compile_graph(self._losses, enabled=compile)

    @property
    def in_keys(self) -> Sequence[NestedKey]:
        """The keys that :meth:`forward` reads; ``priority_weight`` is optional."""
        keys = self.tensor_keys
        following = (keys.observation, keys.reward, keys.terminated)
        return [
            keys.observation,
            keys.action,
            keys.valid,
            *(unravel_key(("next", key)) for key in following),
        ]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """The targets are computed here; there is no value estimator to tell."""

    def forward(
        self, tensordict: TensorDictBase, generator: torch.Generator | None = None
    ) -> TensorDict:
        """The losses of ``[N, H]`` transitions.

        Args:
            tensordict: slices of episodes.
            generator: source of the noise on the policy's actions.

        Returns:
            Scalars; all but ``loss_model`` and ``loss_policy`` are for the log. ``td_error``
            ``[N]`` is the priority of each slice.
        """
        keys, following = self.tensor_keys, tensordict.get("next")
        shape = tensordict.batch_size
        action = tensordict.get(keys.action)
        slices = Slices(
            observation=tensordict.get(keys.observation),
            action=action,
            reward=following.get(keys.reward).reshape(shape),
            next_observation=following.get(keys.observation),
            terminated=following.get(keys.terminated).reshape(shape),
            valid=tensordict.get(keys.valid).reshape(shape),
        )
        weight = tensordict.get(keys.priority_weight, None)
        weight = torch.ones(shape[0], device=action.device) if weight is None else weight
        # One more step than transitions: the policy also acts in the last latent.
        size = (2, shape[0], shape[1] + 1, action.shape[-1])
        noise = torch.randn(size, generator=generator, device=action.device)
        noise = (self.config.policy_noise * noise).clamp(-_NOISE_CLIP, _NOISE_CLIP)
        weight = weight.reshape(shape[0], -1)[:, 0]
        model, policy, losses = self._core(slices, weight, noise)
        names = ("consistency", "reward", "value", "termination")
        return TensorDict(
            {
                "loss_model": model,
                "loss_policy": policy,
                **{f"loss_{name}": getattr(losses, name).detach().mean() for name in names},
                "td_error": losses.td_error,
            }
        )

    def _losses(
        self, slices: Slices, weight: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor, ModelLosses]:
        c = self.config
        target = td_target(self.told, self.target, slices, noise[0, :, 1:], c.gamma)
        losses, latents = model_losses(self.told, self.target, slices, target, c.rho)
        total = (
            c.consistency_coef * losses.consistency
            + c.reward_coef * losses.reward
            + c.value_coef * losses.value
            + c.termination_coef * losses.termination
        )
        horizon = slices.valid.shape[1]
        policy = policy_loss(self.told, latents, slices, noise[1], c.rho, c.output_penalty)
        return (weight * total).mean() / horizon, policy, losses

    @torch.no_grad()
    def update_target(self, tau: float) -> None:
        """Move the targets: targets ← (1 - tau) targets + tau networks."""
        for name in ("encoder", "critics"):
            target, source = (list(_part(net, name)) for net in (self.target, self.told))
            soft_update_(target, source, tau)


def _part(told: nn.Module, name: str) -> Sequence[Tensor]:
    return [p.detach() for p in getattr(told, name).parameters()]
