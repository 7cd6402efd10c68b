"""Checkpoints without pickle, written atomically; a damaged one is replaced by an earlier one."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.checkpoint import Checkpoint, CheckpointAdapter, CheckpointError, CheckpointRotation

_log = logging.getLogger(__name__)

FORMAT = 1
"""Version of the content of a checkpoint; other versions are refused."""


class SafeStateAdapter(CheckpointAdapter):
    """A nested state of tensors, numbers and texts as one safetensors file and one JSON file.

    TorchRL's own adapter reads a directory with TensorDict, which unpickles files of a hostile
    directory. The digest detects damaged files.
    """

    adapter_id = "phihp_torchrl.safe_state"
    format_version = FORMAT

    def save(
        self, component: Any, path: Path, *, args: tuple[Any, ...], kwargs: Mapping[str, Any]
    ) -> Any:
        path.mkdir(parents=True, exist_ok=True)
        tensors: dict[str, Tensor] = {}
        tree = _encode(component.state_dict(), tensors)
        data = save_tensors(tensors)
        (path / "tensors.safetensors").write_bytes(data)
        digest = hashlib.sha256(data).hexdigest()
        (path / "tree.json").write_text(
            json.dumps({"tensors": digest, "tree": tree}), encoding="utf-8"
        )

    def load(
        self,
        component: Any,
        path: Path,
        *,
        map_location: Any,
        tensor_load_kwargs: Mapping[str, Any],
        args: tuple[Any, ...],
        kwargs: Mapping[str, Any],
    ) -> Any:
        record = json.loads((path / "tree.json").read_text(encoding="utf-8"))
        data = (path / "tensors.safetensors").read_bytes()
        if hashlib.sha256(data).hexdigest() != record["tensors"]:
            raise CheckpointError(
                f"{path / 'tensors.safetensors'}: damaged, its digest is another."
            )
        component.load_state_dict(_decode(record["tree"], load_tensors(data)))


class State:
    """Holds a state while a checkpoint is written or read."""

    def __init__(self, state: Mapping[str, Any] | None = None) -> None:
        self.state = state or {}

    def state_dict(self) -> Mapping[str, Any]:
        return self.state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.state = state


def save_state(
    directory: CheckpointRotation | Path,
    state: Mapping[str, Any],
    *,
    metadata: Mapping[str, Any],
    step: int = 0,
) -> Path:
    """Save ``state`` in a rotation of checkpoints or at a path, atomically.

    Args:
        directory: the rotation, or the path of a single checkpoint.
        state: nested dictionaries, lists and tuples of tensors, tensordicts, numbers and texts.
        metadata: description of the state; :func:`load_state` requires an equal one.
        step: position in the rotation.
    """
    checkpoint = _checkpoint(State(state))
    metadata = {**metadata, "format": FORMAT}
    if isinstance(directory, CheckpointRotation):
        return directory.save(checkpoint, step=step, metadata=metadata)
    return checkpoint.save(directory, metadata=metadata)


def load_state(path: Path, *, metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Read the state in the checkpoint at ``path``.

    Raises:
        CheckpointError: if it is absent, damaged, of another version or of something else than
            ``metadata`` says; the message names the path.
    """
    holder = State()
    try:
        found = Checkpoint.manifest(path).get("metadata")
        found = found if isinstance(found, Mapping) else {}
        for key, expected in {**metadata, "format": FORMAT}.items():
            if found.get(key) != expected:
                raise CheckpointError(f"expected {key} {expected!r}, found {found.get(key)!r}.")
        _checkpoint(holder).load(path)
    # A hostile or truncated file may raise anything; the user should read one sentence.
    except Exception as error:
        raise CheckpointError(f"{path}: not a usable checkpoint: {error}") from error
    return dict(holder.state)


def load_latest(
    rotation: CheckpointRotation, *, metadata: Mapping[str, Any]
) -> tuple[int, dict[str, Any]] | None:
    """Return the newest intact state of a rotation and its step; ``None`` for an empty rotation.

    A damaged checkpoint is renamed with a warning, and the one before it is used.

    Raises:
        CheckpointError: if there are checkpoints, but none of them can be read.
    """
    paths = rotation_paths(rotation)
    errors = []
    for path in reversed(paths):
        try:
            state = load_state(path, metadata=metadata)
        except CheckpointError as error:
            errors.append((path, error))
            continue
        for broken, reason in errors:
            _log.warning("%s It is set aside, and %s used in its place.", reason, path)
            aside = broken.with_name(f"damaged-{broken.name}")
            shutil.rmtree(aside, ignore_errors=True)
            broken.rename(aside)
        return int(path.name.rpartition("-")[2]), state
    if errors:
        raise errors[0][1]
    return None


def rotation_paths(rotation: CheckpointRotation) -> list[Path]:
    """List the checkpoints of a rotation by step, including damaged ones."""
    return sorted(rotation.directory.glob(f"{rotation.prefix}-" + "[0-9]" * 12))


def clear_rotation(rotation: CheckpointRotation) -> None:
    """Remove a rotation's checkpoints, and files of interrupted saves."""
    for path in [*rotation_paths(rotation), *rotation.directory.glob(f".{rotation.prefix}-*")]:
        shutil.rmtree(path, ignore_errors=True)


def _checkpoint(state: State) -> Checkpoint:
    return Checkpoint().register("state", state, adapter=SafeStateAdapter())


def _encode(value: Any, tensors: dict[str, Tensor]) -> Any:
    """``value`` as JSON; its tensors go into ``tensors``."""
    if isinstance(value, Tensor):
        name = str(len(tensors))
        # A clone, since safetensors refuses tensors that share memory.
        tensors[name] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
        return {"tensor": name}
    if isinstance(value, TensorDictBase):
        items = {key: value.get(key) for key in value.keys()}  # noqa: SIM118 (its iteration is over rows)
        return {"tensordict": _encode(items, tensors), "batch_size": list(value.batch_size)}
    if isinstance(value, Mapping):
        pairs = [[_encode(k, tensors), _encode(v, tensors)] for k, v in value.items()]
        return {"dict": pairs}
    if isinstance(value, (list, tuple)):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return {kind: [_encode(item, tensors) for item in value]}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"A checkpoint holds tensors, numbers and texts, not {type(value).__name__}.")


def _decode(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    if not isinstance(value, dict):
        return value
    if "tensor" in value:
        return tensors[value["tensor"]]
    if "tensordict" in value:
        return TensorDict(_decode(value["tensordict"], tensors), value["batch_size"])
    if "dict" in value:
        return {_decode(k, tensors): _decode(v, tensors) for k, v in value["dict"]}
    if "tuple" in value:
        return tuple(_decode(item, tensors) for item in value["tuple"])
    return [_decode(item, tensors) for item in value["list"]]
