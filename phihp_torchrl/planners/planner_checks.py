"""What a planner checks: its actor and critics, its keys, and the observations it plans from."""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import TransformedEnv

from phihp_torchrl.config import ConfigError
from phihp_torchrl.planners.transformed import computed_keys, why_no_tensor_model

if TYPE_CHECKING:
    from phihp_torchrl.planners.sampling_planner import SamplingPlanner

_logger = logging.getLogger(__name__)

Specs = Mapping[NestedKey, TensorSpec]


def choose_observation(situation: Collection[NestedKey], key: NestedKey | None) -> NestedKey | None:
    """Return the key of the observation for a tensor model, or ``None`` if it is ambiguous."""
    if key is not None:
        if unravel_key(key) not in situation:
            raise ConfigError("observation_key", f"expected one of {list(situation)}, got {key!r}.")
        return unravel_key(key)
    if "observation" in situation:
        return "observation"
    return next(iter(situation)) if len(situation) == 1 else None


def module_keys(planner: SamplingPlanner) -> list[NestedKey]:
    """Return the keys that actor and critics read besides the action."""
    modules = [module for module in (planner.actor, planner.qvalue) if module is not None]
    keys = [unravel_key(key) for module in modules for key in module.in_keys]
    return [key for key in keys if key != planner.action_key]


def check_modules(planner: SamplingPlanner, situation: Collection[NestedKey]) -> None:
    """Raise if actor and critics do not fit the settings, or their keys the environment."""
    actor, qvalue, settings = planner.actor, planner.qvalue, planner.settings
    if actor is None and settings.num_policy_candidates:
        raise ConfigError(
            "actor",
            "expected a module to propose num_policy_candidates="
            f"{settings.num_policy_candidates} sequences, got None.",
        )
    if actor is None and qvalue is not None:
        raise ConfigError(
            "actor", "expected a module to act beyond the horizon, for qvalue, got None."
        )
    for name, module, key in (
        ("actor", actor, planner.action_key),
        ("qvalue", qvalue, planner.value_key),
    ):
        if module is None:
            continue
        if key not in (keys := getattr(module, "out_keys", [])):
            raise ConfigError(
                name,
                f"expected a TensorDict module that writes {key!r}, "
                f"got {type(module).__name__} that writes {list(keys)}.",
            )
        allowed = [*situation, *([planner.action_key] if module is qvalue else [])]
        if unknown := [k for k in module.in_keys if unravel_key(k) not in allowed]:
            raise ConfigError(name, f"expected in_keys among {allowed}, got {unknown}.")


def needed_keys(
    planner: SamplingPlanner, situation: Specs, given: Sequence[NestedKey] | None
) -> list[NestedKey]:
    """Return the keys that a plan is made from: those ``given``, or those that it needs."""
    read = module_keys(planner)
    # With either backend, a tensor model computes the state from one observation.
    own = why_no_tensor_model(planner.env, planner.reward_key) is None
    own = own and (planner.uses_tensors or not isinstance(planner.env, TransformedEnv))
    if own and planner.observation_key is not None:
        needed = [planner.observation_key, *read]
    else:
        needed = [key for key in situation if key not in computed_keys(planner.env) or key in read]
    needed = list(dict.fromkeys(needed))
    if given is None:
        return needed
    keys = [unravel_key(key) for key in given]
    if unknown := [key for key in keys if key not in situation]:
        raise ConfigError("in_keys", f"expected some of {list(situation)}, got {unknown}.")
    must = {*read, *([planner.observation_key] if planner.uses_tensors else [])}
    if missing := [key for key in needed if key in must and key not in keys]:
        raise ConfigError("in_keys", f"expected {missing} among them, got {keys}.")
    return keys


def log_backend(planner: SamplingPlanner, no_tensors: str | None, compile: bool) -> None:
    """Say which backend a planner uses and why, and what of its arguments has no effect."""
    name, settings = type(planner).__name__, planner.settings
    if not planner.uses_tensors:
        _logger.log(
            logging.WARNING if compile else logging.INFO,
            "%s steps the environment%s: %s.",
            name,
            ", which is not compiled" if compile else "",
            no_tensors or "backend='env'",
        )
    elif compile and not planner._compiles:
        _logger.warning("%s is not compiled: the model's integrator does not compile.", name)
    idle = planner.qvalue is None or not settings.alpha
    if planner.actor is not None and not settings.num_policy_candidates and idle:
        _logger.warning(
            "%s acts by its actor only where no sequence has a finite score: with "
            "num_policy_candidates = 0 and no value beyond the horizon it has no other use.",
            name,
        )


def finite_keys(planner: SamplingPlanner, expected: Specs) -> frozenset[NestedKey]:
    """The expected keys that matter to plans, which must be finite."""
    stepped_from = {unravel_key(k) for k in planner.env.full_state_spec_unbatched.keys(True, True)}
    matters = {planner.observation_key, *module_keys(planner), *stepped_from}
    return frozenset(key for key in expected if key in matters or not stepped_from)


def check_observation(
    planner: SamplingPlanner,
    tensordict: TensorDictBase,
    expected: Specs,
    finite: Collection[NestedKey],
    device: torch.device,
) -> None:
    """Raise if an observation is missing, of the wrong shape, dtype or device, or not finite."""
    batch = tensordict.batch_size
    for key, spec in expected.items():
        value = tensordict.get(key, None)
        shape = torch.Size([*batch, *spec.shape])
        if value is None:
            raise ConfigError(str(key), f"expected a tensor of shape {list(shape)}, got none.")
        if value.shape != shape or value.dtype != spec.dtype or value.device != device:
            raise ConfigError(
                str(key),
                f"expected {spec.dtype} of shape {list(shape)} on {device}, "
                f"got {value.dtype} of shape {list(value.shape)} on {value.device}.",
            )
        # On other devices this would synchronize; the plan then uses the actor's action.
        checked = planner.check_finite and key in finite and device.type == "cpu"
        if checked and not is_finite(value):
            raise ConfigError(str(key), "expected finite observations, got some that are not.")


def is_finite(values: Tensor) -> bool:
    """Whether all values are finite; their sum says so first, in a third of the time."""
    return math.isfinite(values.sum().item()) or bool(values.isfinite().all())
