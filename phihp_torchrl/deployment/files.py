"""Agents on disk: one JSON file and one safetensors file of weights, without pickle."""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as dump_tensors
from torch import Tensor, nn

from phihp_torchrl.config import (
    DIGEST,
    check_seal,
    digest_of,
    names_file,
    sealed,
)
from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.deployment.defaults import plain_defaults
from phihp_torchrl.deployment.formats import (
    AGENT_FILE,
    BOUNDS_OF_VERSION_1,
    FORMAT,
    FORMAT_VERSION,
    SAVING,
    upgrade,
)
from phihp_torchrl.deployment.kinds import find_kind
from phihp_torchrl.deployment.package import (
    PACKAGE_FILE,
    drop_package_of_another,
    place_package,
    take_package,
    write_package,
)
from phihp_torchrl.deployment.reading import MAX_JSON_BYTES, AgentError, read_json, read_weights
from phihp_torchrl.deployment.saved_task import describe_task, find_task, read_signature
from phihp_torchrl.origin import package_version
from phihp_torchrl.tasks import Task

_log = logging.getLogger(__name__)
WEIGHTS_FILE = "weights.safetensors"
NEXT_WEIGHTS_FILE = ".next-weights.safetensors"
"""Weights of a saving that was cut off after ``agent.json`` was replaced, or before."""


def save_agent(
    agent: Agent,
    directory: str | os.PathLike[str],
    *,
    metadata: Mapping[str, Any] | None = None,
    packaged: bool = False,
) -> Path:
    """Save an agent as ``agent.json`` and ``weights.safetensors``, keeping other files.

    However the saving ends, the directory holds a whole agent, the old one or the new: the new
    weights are written beside the old ones, ``agent.json`` with their digest is then replaced in
    one step, and loading takes the weights that belong to it.

    Args:
        agent: the agent, on any device.
        directory: the directory; it is made if absent.
        metadata: further information for people, as JSON values with finite numbers; by convention
            ``seed``, ``commit``, ``command``, ``samples``, ``config`` and ``returns``. Defaults to
            ``agent.metadata``.
        packaged: whether to compile the plan too, as ``packaged_plan.pt2`` for this platform, which
            takes half a minute; :func:`load_agent` then loads it in less than a second.

    Returns:
        The directory.

    Raises:
        AgentError: for an agent with modules that have no ``config``, with weights that are not
            finite, or with metadata that is not JSON.

    Examples:
        >>> import tempfile
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.agents import Actor
        >>> agent = Agent(get_task("pendulum"), actor=Actor(get_task("pendulum")))
        >>> with tempfile.TemporaryDirectory() as directory:
        ...     sorted(path.name for path in save_agent(agent, directory).iterdir())
        ['agent.json', 'weights.safetensors']
    """
    try:
        config = agent.config
        # What can not be built again should not be saved.
        type(agent).build_modules(agent.task, json.loads(json.dumps(config)))
    except (ValueError, TypeError, KeyError) as error:
        raise AgentError(f"agent: it can not be saved: {error}") from error
    weights = {
        name: tensor.detach().cpu().contiguous().clone()
        for name, tensor in _tensors(agent.modules_by_name()).items()
    }
    for name, tensor in weights.items():
        if not tensor.isfinite().all():
            raise AgentError(f"agent: it can not be saved: {name} has non-finite values.")
    data = dump_tensors(weights)
    content = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "package_version": package_version(),
        "kind": agent.kind,
        **describe_task(agent.task),
        **config,
        "weights_sha256": digest_of(data),
        "metadata": dict(agent.metadata if metadata is None else metadata),
    }
    try:
        json.dumps(content, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise AgentError(f"metadata: expected JSON with finite numbers: {error}.") from error
    text = sealed(content)
    if len(text.encode()) > MAX_JSON_BYTES:
        raise AgentError(f"metadata: expected at most {MAX_JSON_BYTES} bytes of JSON.")
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    for left in directory.glob(f"{SAVING}*"):  # by savings that were killed
        shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=directory, prefix=SAVING) as temporary:
        for name, payload in ((WEIGHTS_FILE, data), (AGENT_FILE, text.encode())):
            with names_file(directory / name), open(Path(temporary, name), "wb") as file:
                file.write(payload)
                file.flush()
                os.fsync(file.fileno())
        os.replace(Path(temporary, WEIGHTS_FILE), directory / NEXT_WEIGHTS_FILE)
        os.replace(Path(temporary, AGENT_FILE), directory / AGENT_FILE)
        os.replace(directory / NEXT_WEIGHTS_FILE, directory / WEIGHTS_FILE)
        drop_package_of_another(directory)
        if packaged:
            made = Path(temporary, PACKAGE_FILE)
            write_package(agent, made)
            place_package(made, directory)
    return directory


@plain_defaults()
def load_agent(
    directory: str | os.PathLike[str],
    *,
    planner: bool | None = None,
    task: str | Task | None = None,
    device: torch.device | str | None = None,
    compile: bool | dict[str, Any] = False,
    packaged: bool | None = None,
) -> Agent:
    """Load a saved agent, ready to act.

    Nothing in the files is executed but a package that you made yourself on this machine, or that
    ``packaged`` asks for, and the sizes of the weights are checked before memory is allocated.

    Args:
        directory: the directory that :func:`save_agent` wrote.
        planner: whether it plans; ``False`` is the actor alone. By default it plans, unless its
            metadata say ``"acting": "actor"``: calibration found no plan that beats its actor.
        task: the task that it must be for: a name, or a task that need not be registered.
        device: device of the agent. Defaults to the CPU.
        compile: whether to compile the plan at its first call. Without it the agent plans at once
            and eagerly; see also :meth:`Agent.warm_up`.
        packaged: whether to plan by the native code of ``packaged_plan.pt2`` beside the agent, for
            one observation at a time on the CPU. By default that is done where you made the package
            yourself, on this machine. A package is a program that runs with your rights, so ask for
            one of others (``True``) only where you trust whoever wrote it. If it is of another
            agent, torch, platform or processor, or there is none that you asked for, a warning says
            so and the agent plans eagerly. So it does after its weights have changed.

    Raises:
        AgentError: if both ``compile`` and ``packaged`` are asked for, or a file is missing,
            damaged, of another version or another task.

    Examples:
        >>> import tempfile
        >>> from phihp_torchrl import get_task, load_agent
        >>> from phihp_torchrl import Agent, save_agent
        >>> from phihp_torchrl.agents import Actor
        >>> task = get_task("pendulum")
        >>> with tempfile.TemporaryDirectory() as directory:
        ...     _ = save_agent(Agent(task, actor=Actor(task)), directory, metadata={"seed": 0})
        ...     load_agent(directory, task="pendulum").metadata
        {'seed': 0}
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise AgentError(f"{directory}: expected the directory of a saved agent, found none.")
    path = directory / AGENT_FILE
    content = read_json(path)
    sealed_content = dict(content)
    content.pop(DIGEST, None)
    _check_format(path, content)
    try:
        content = upgrade(content)
        kind = find_kind(content.get("kind"))
        signature = read_signature(content["task"])
    except KeyError as error:
        raise AgentError(f"{path}: expected the key {error}, found none.") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise AgentError(f"{path}: {error}") from error
    task = find_task(path, signature, task, content)
    weights = _read_weights(directory / WEIGHTS_FILE, kind, task, content)
    try:
        check_seal(sealed_content)  # last, for other errors say more
    except ValueError as error:
        raise AgentError(f"{path}: {error}.") from error
    device = _check_device(device)
    if packaged and compile:
        raise AgentError("packaged: expected it without compile, got both.")
    try:
        parts = kind.build_modules(task, content)
        for name, part in parts.items():
            start = f"{name}."
            own = {k.removeprefix(start): t for k, t in weights.items() if k.startswith(start)}
            part.load_state_dict(own)
            part.to(device).requires_grad_(False).eval()
        agent = kind.from_config(
            task,
            content,
            parts,
            use_planner=_plans(content) if planner is None else planner,
            compile=compile,
            metadata=content["metadata"],
        )
    except KeyError as error:
        raise AgentError(f"{path}: expected the key {error}, found none.") from error
    except (ValueError, TypeError, RuntimeError) as error:
        raise AgentError(f"{path}: the agent can not be built: {error}") from error
    there = (directory / PACKAGE_FILE).is_file()
    fits = there and agent.planner is not None and device.type == "cpu" and not compile
    if packaged or (packaged is None and fits):
        take_package(agent, directory, device, trusted=bool(packaged))
    return agent


def _plans(content: Mapping[str, Any]) -> bool:
    return content["metadata"].get("acting") != "actor"


def _check_format(path: Path, content: dict[str, Any]) -> None:
    if content.get("format") != FORMAT:
        raise AgentError(f"{path}: expected format {FORMAT!r}, got {content.get('format')!r}.")
    version = content.get("format_version")
    if version not in range(1, FORMAT_VERSION + 1) or isinstance(version, bool):
        raise AgentError(
            f"{path}: expected format_version 1 to {FORMAT_VERSION}, got {version!r}; it was "
            f"written by version {content.get('package_version')!r} of this package, here is "
            f"{package_version()}."
        )
    if not isinstance(content.get("metadata"), dict):
        raise AgentError(
            f"{path}: metadata: expected a JSON object, got {content.get('metadata')!r}."
        )


def _read_weights(
    path: Path, kind: type[Agent], task: Task, content: dict[str, Any]
) -> dict[str, Tensor]:
    agent_path = path.with_name(AGENT_FILE)
    try:
        with torch.device("meta"):  # shapes without memory
            parts = kind.build_modules(task, content)
    except KeyError as error:
        raise AgentError(f"{agent_path}: expected the key {error}, found none.") from error
    except (ValueError, TypeError, RuntimeError, AttributeError) as error:
        raise AgentError(f"{agent_path}: {error}") from error
    options: Any = {"expected": _tensors(parts), "ignore": f".{BOUNDS_OF_VERSION_1}"}
    digest, coming = content.get("weights_sha256"), path.with_name(NEXT_WEIGHTS_FILE)
    if coming.is_file():
        with suppress(AgentError):  # else they are of a saving that was cut off earlier
            weights, data = read_weights(coming, **options)
            if digest_of(data) == digest:
                return weights
    weights, data = read_weights(path, **options)
    if digest_of(data) != digest:
        raise AgentError(
            f"{path}: expected the weights that {AGENT_FILE} was written with, got others; "
            "were the files copied from two agents?"
        )
    return weights


def _tensors(parts: Mapping[str, nn.Module]) -> dict[str, Tensor]:
    return {
        f"{part}.{name}": tensor
        for part, module in parts.items()
        for name, tensor in module.state_dict().items()
    }


def _check_device(device: torch.device | str | None) -> torch.device:
    try:
        return torch.empty(0, device=device or "cpu").device
    except (RuntimeError, AssertionError) as error:
        raise AgentError(
            f"device: expected one that works here, got {device!r}: {error}"
        ) from error
