"""Observations without limits as such in specs, so that these can be sampled."""

from __future__ import annotations

import torch
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform


class OpenLimits(Transform):
    """Makes bounded specs of observations unbounded where one of their limits is infinite.

    gymnasium says of a velocity that it lies between minus and plus infinity. TorchRL keeps that as
    a bounded spec, and samples NaN from it. Nothing but the spec changes.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("MountainCarContinuous-v0"), OpenLimits())
        >>> env.observation_spec["observation"].rand().isfinite().all()
        tensor(True)
    """

    def __init__(self) -> None:
        super().__init__(in_keys=[], out_keys=[])

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        for key in list(observation_spec.keys(True, True)):
            if is_open(spec := observation_spec[key]):
                observation_spec[key] = Unbounded(spec.shape, dtype=spec.dtype, device=spec.device)
        return observation_spec


def is_open(spec: TensorSpec) -> bool:
    """Whether a spec is bounded in name, with an infinite limit."""
    if not isinstance(spec, Bounded) or not spec.dtype.is_floating_point:
        return False
    return not bool(torch.isfinite(torch.stack([spec.space.low, spec.space.high])).all())


def open_limits(env: EnvBase) -> list[Transform]:
    """Return an :class:`OpenLimits` for an environment that needs one, and else nothing."""
    specs: Composite = env.observation_spec
    return [OpenLimits()] if any(is_open(specs[key]) for key in specs.keys(True, True)) else []
