"""Reading an agent's files without trusting them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, NoReturn

from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from torch import Tensor

from phihp_torchrl.agents.tdmpc.told import TOLDConfig
from phihp_torchrl.deployment.blueprint import (
    Blueprint,
    DynamicsBlueprint,
    ResidualBlueprint,
    TaskSignature,
)
from phihp_torchrl.deployment.kinds import AnyBlueprint, is_tdmpc
from phihp_torchrl.deployment.tdmpc import TDMPCBlueprint
from phihp_torchrl.planners.factory import PlannerConfig
from phihp_torchrl.planners.settings import MPPISettings

MAX_JSON_BYTES = 1_000_000
_MAX_WEIGHT_BYTES = 1_000_000_000
_MAX_HEADER_BYTES = 100_000  # what safetensors writes about our few dozen tensors, with room


class AgentError(ValueError):
    """An agent that can not be saved or loaded: the message names the file and what should be."""


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in ``path``."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is not a number")

    data = _read_bytes(path, MAX_JSON_BYTES)
    try:
        content = json.loads(data.decode(), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise AgentError(f"{path}: expected JSON, got something else: {error}.") from error
    if not isinstance(content, dict):
        raise AgentError(f"{path}: expected a JSON object, got {type(content).__name__}.")
    return content


def _read_bytes(path: Path, limit: int) -> bytes:
    if not path.is_file():
        raise AgentError(f"{path}: expected this file of a saved agent, found none.")
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            data = file.read(size) if size <= limit else b""
    except OSError as error:
        raise AgentError(f"{path}: it can not be read: {error}.") from error
    if size > limit:
        raise AgentError(f"{path}: expected at most {limit} bytes, got {size}.")
    return data


def read_blueprint(path: Path, content: dict[str, Any]) -> AnyBlueprint:
    """The blueprint in an agent's JSON, checked."""
    kind = TDMPCBlueprint if is_tdmpc(content) else Blueprint
    try:
        own = {field.name: content[field.name] for field in fields(kind)}
        own["task"] = _from_json(TaskSignature, "task", own["task"])
        if kind is TDMPCBlueprint:
            own["told"] = _from_json(TOLDConfig, "told", own["told"])
            if own["planner"] is not None:
                own["planner"] = _from_json(MPPISettings, "planner", own["planner"])
            return _from_json(kind, "agent", own)
        if (dynamics := own["dynamics"]) is not None:
            if isinstance(dynamics, dict) and dynamics.get("residual") is not None:
                residual = _from_json(ResidualBlueprint, "dynamics.residual", dynamics["residual"])
                dynamics = {**dynamics, "residual": residual}
            own["dynamics"] = _from_json(DynamicsBlueprint, "dynamics", dynamics)
        if own["planner"] is not None:
            # A setting that came later has a default that changes nothing.
            defaults = asdict(PlannerConfig())
            own["planner"] = _from_json(PlannerConfig, "planner", own["planner"], defaults)
        return _from_json(Blueprint, "agent", own)
    except KeyError as error:
        raise AgentError(f"{path}: expected the key {error}, found none.") from error
    except (ValueError, TypeError) as error:
        raise AgentError(f"{path}: {error}") from error


def _from_json(
    kind: type, where: str, value: Any, defaults: Mapping[str, Any] | None = None
) -> Any:
    names = {field.name for field in fields(kind) if field.init}
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected an object with {sorted(names)}, got {value!r}.")
    value = {**(defaults or {}), **value}
    if set(value) != names:
        raise ValueError(f"{where}: expected the keys {sorted(names)}, got {sorted(value)}.")
    arguments = {k: tuple(v) if isinstance(v, list) else v for k, v in value.items()}
    try:
        return kind(**arguments)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where}: {error}") from error


def read_weights(path: Path, expected: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], bytes]:
    """The tensors in ``path`` and its bytes.

    Args:
        path: a safetensors file.
        expected: tensors of the names, shapes and dtypes that must be there, on the meta device.
    """
    size = sum(tensor.numel() * tensor.element_size() for tensor in expected.values())
    data = _read_bytes(path, min(size + _MAX_HEADER_BYTES, _MAX_WEIGHT_BYTES))
    try:
        weights = load_tensors(data)
    except (SafetensorError, ValueError, KeyError, TypeError, RuntimeError, OverflowError) as error:
        raise AgentError(
            f"{path}: expected about {size} bytes of safetensors, got {len(data)} bytes that are "
            f"damaged or something else: {error}."
        ) from error
    missing, extra = sorted(set(expected) - set(weights)), sorted(set(weights) - set(expected))
    if missing or extra:
        raise AgentError(
            f"{path}: expected the tensors of the agent's description; "
            f"missing {missing}, not expected {extra}."
        )
    for name, tensor in weights.items():
        wanted = expected[name]
        if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
            raise AgentError(
                f"{path}: {name}: expected {wanted.dtype} of shape {list(wanted.shape)}, "
                f"got {tensor.dtype} of shape {list(tensor.shape)}."
            )
        if not tensor.isfinite().all():
            raise AgentError(f"{path}: {name}: expected finite values, got some that are not.")
    return weights, data
