"""Checkpoints without pickle, written atomically; a damaged one is replaced by an earlier one."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.checkpoint import Checkpoint, CheckpointAdapter, CheckpointError, CheckpointRotation

from phihp_torchrl.config import DIGEST, digest_of, names_file

_log = logging.getLogger(__name__)

FORMAT = 2
"""Version of the content of a checkpoint; later versions are refused.

Version 1 has a digest of its tensors alone.
"""


class SafeStateAdapter(CheckpointAdapter):
    """A nested state of tensors, numbers and texts as one safetensors file and one JSON file.

    TorchRL's own adapter reads a directory with TensorDict, which unpickles files of a hostile
    directory. The JSON file has the digest of the tensors, and the description of the checkpoint
    that of the JSON file, so that a damaged file is detected, whichever it is.
    """

    adapter_id = "phihp_torchrl.safe_state"

    def __init__(self, version: int = FORMAT) -> None:
        self.format_version = version

    def save(
        self, component: Any, path: Path, *, args: tuple[Any, ...], kwargs: Mapping[str, Any]
    ) -> Any:
        path.mkdir(parents=True, exist_ok=True)
        with names_file(path / "tensors.safetensors"):
            (path / "tensors.safetensors").write_bytes(component.data)
        with names_file(path / "tree.json"):
            (path / "tree.json").write_text(component.tree, encoding="utf-8")

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
        text = (path / "tree.json").read_bytes()
        if component.digest not in (None, digest_of(text)):
            raise CheckpointError(f"{path / 'tree.json'}: damaged, its digest is another.")
        record = json.loads(text)
        data = (path / "tensors.safetensors").read_bytes()
        if digest_of(data) != record["tensors"]:
            raise CheckpointError(
                f"{path / 'tensors.safetensors'}: damaged, its digest is another."
            )
        component.load_state_dict(_decode(record["tree"], load_tensors(data)))


class Frozen(NamedTuple):
    """A state as it was at a moment: nothing that happens to its tensors later changes it.

    Attributes:
        tree: the state as JSON, in which tensors have names.
        tensors: copies of the tensors on the CPU, by name.
    """

    tree: Any
    tensors: dict[str, Tensor]


def freeze(state: Mapping[str, Any]) -> Frozen:
    """Copy a state, to be saved later or never.

    Args:
        state: as of :func:`save_state`.

    Examples:
        >>> weight = torch.zeros(1)
        >>> frozen = freeze({"weight": weight})
        >>> weight += 1
        >>> frozen.tensors
        {'0': tensor([0.])}
    """
    tensors: dict[str, Tensor] = {}
    return Frozen(_encode(state, tensors), tensors)


class State:
    """Holds a state while a checkpoint is written or read.

    Args:
        state: the state to write, or a frozen one.
        digest: the digest that the JSON file to read must have; ``None`` for any.
    """

    def __init__(
        self, state: Mapping[str, Any] | Frozen | None = None, digest: str | None = None
    ) -> None:
        self.state: Any = {}
        tree, tensors = state if isinstance(state, Frozen) else freeze(state or {})
        self.data = save_tensors(tensors)
        self.tree = json.dumps({"tensors": digest_of(self.data), "tree": tree})
        self.digest = digest

    def state_dict(self) -> Any:
        return self.state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.state = state


def save_state(
    directory: CheckpointRotation | Path,
    state: Mapping[str, Any] | Frozen,
    *,
    metadata: Mapping[str, Any],
    step: int = 0,
) -> Path:
    """Save ``state`` in a rotation of checkpoints or at a path, atomically.

    Args:
        directory: the rotation, or the path of a single checkpoint.
        state: nested dictionaries, lists and tuples of tensors, tensordicts, numbers and texts; or
            such a state as :func:`freeze` has copied it.
        metadata: description of the state; :func:`load_state` requires an equal one.
        step: position in the rotation.
    """
    holder = State(state)
    checkpoint = _checkpoint(holder)
    metadata = {**metadata, "format": FORMAT, DIGEST: digest_of(holder.tree)}
    if isinstance(directory, CheckpointRotation):
        return directory.save(checkpoint, step=step, metadata=metadata)
    return checkpoint.save(directory, metadata=metadata)


def load_state(path: Path, *, metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Read the state in the checkpoint at ``path``.

    Raises:
        CheckpointError: if it is absent, damaged, of another version or of something else than
            ``metadata`` says; the message names the path.
    """
    try:
        found = Checkpoint.manifest(path).get("metadata")
        found = found if isinstance(found, Mapping) else {}
        version = 1 if found.get("format") == 1 else FORMAT
        for key, expected in {**metadata, "format": version}.items():
            if found.get(key) != expected:
                raise CheckpointError(f"expected {key} {expected!r}, found {found.get(key)!r}.")
        digest = None if version == 1 else str(found.get(DIGEST))
        holder = State(digest=digest)
        _checkpoint(holder, version).load(path)
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
    """Remove a rotation's checkpoints, and files of interrupted saves and removals.

    Whenever it is killed, a checkpoint is whole or has a name by which none is looked for.
    """
    for path in rotation_paths(rotation):
        with suppress(OSError):
            path.rename(path.with_name(f".{path.name}-removed"))
    for path in rotation.directory.glob(f".{rotation.prefix}-*"):
        shutil.rmtree(path, ignore_errors=True)


def _checkpoint(state: State, version: int = FORMAT) -> Checkpoint:
    return Checkpoint().register("state", state, adapter=SafeStateAdapter(version))


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
