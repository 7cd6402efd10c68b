"""Reading an agent's files, which may be damaged or hostile."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from torch import Tensor

MAX_JSON_BYTES = 1_000_000
_MAX_WEIGHT_BYTES = 1_000_000_000
_MAX_HEADER_BYTES = 100_000  # what safetensors writes about our few dozen tensors, with room


class AgentError(ValueError):
    """The error of an agent that cannot be saved or loaded, with the file and what was expected.

    Examples:
        >>> from phihp_torchrl import load_agent
        >>> try:
        ...     load_agent("no/such/directory")
        ... except AgentError as error:
        ...     print(error)
        no/such/directory: expected the directory of a saved agent, found none.
    """


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


def read_weights(
    path: Path, expected: Mapping[str, Tensor], *, ignore: str
) -> tuple[dict[str, Tensor], bytes]:
    """The tensors in ``path`` and its bytes.

    Args:
        path: a safetensors file.
        expected: tensors of the names, shapes and dtypes that must be there, on the meta device.
        ignore: ending of names that older files have besides.

    Raises:
        AgentError: if the file is missing, damaged, or holds other tensors.
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
    ignored = [name for name in weights if name not in expected and name.endswith(ignore)]
    weights = {name: tensor for name, tensor in weights.items() if name not in ignored}
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
