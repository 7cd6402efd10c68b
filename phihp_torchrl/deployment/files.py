"""Agents on disk: one JSON file and one of weights, without pickle."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as dump_tensors
from torch import Tensor, nn

from phihp_torchrl.deployment.agent import Agent
from phihp_torchrl.deployment.blueprint import TaskSignature
from phihp_torchrl.deployment.kinds import AnyBlueprint, describe, modules
from phihp_torchrl.deployment.reading import (
    MAX_JSON_BYTES,
    AgentError,
    read_blueprint,
    read_json,
    read_weights,
)
from phihp_torchrl.tasks import Task, get_task

AGENT_FILE = "agent.json"
WEIGHTS_FILE = "weights.safetensors"
FORMAT = "phihp_torchrl agent"
FORMAT_VERSION = 1


def save_agent(
    agent: Agent, directory: str | os.PathLike[str], *, metadata: Mapping[str, Any] | None = None
) -> Path:
    """Write ``agent.json`` and ``weights.safetensors``; other files in ``directory`` stay.

    Each file is replaced as a whole, and a mixture of two savings is noticed on loading.

    Args:
        agent: the agent, on any device.
        directory: where to; made if absent.
        metadata: what people should know, in JSON with finite numbers: by convention ``seed``,
            ``commit``, ``command``, ``samples``, ``config`` and the ``returns`` it earned. Defaults
            to the agent's own.

    Returns:
        The directory.

    Raises:
        AgentError: for an agent with parts that are not this package's, with weights that are not
            finite, or metadata that is not JSON.
    """
    try:
        blueprint = describe(agent)
        blueprint.build_modules(agent.task)  # what can not be built again should not be saved
    except (ValueError, TypeError) as error:
        raise AgentError(f"agent: it can not be saved: {error}") from error
    weights = {
        name: tensor.detach().cpu().contiguous().clone()
        for name, tensor in _tensors(modules(agent)).items()
    }
    for name, tensor in weights.items():
        if not tensor.isfinite().all():
            raise AgentError(f"agent: it can not be saved: {name} has non-finite values.")
    data = dump_tensors(weights)
    content = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "package_version": _package_version(),
        **asdict(blueprint),
        "weights_sha256": hashlib.sha256(data).hexdigest(),
        "metadata": dict(agent.metadata if metadata is None else metadata),
    }
    try:
        text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    except (TypeError, ValueError) as error:
        raise AgentError(f"metadata: expected JSON with finite numbers: {error}.") from error
    if len(text.encode()) > MAX_JSON_BYTES:
        raise AgentError(f"metadata: expected at most {MAX_JSON_BYTES} bytes of JSON.")
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=directory, prefix=".saving-") as temporary:
        for name, payload in ((WEIGHTS_FILE, data), (AGENT_FILE, text.encode())):
            with open(Path(temporary, name), "wb") as file:
                file.write(payload)
                file.flush()
                os.fsync(file.fileno())
        for name in (WEIGHTS_FILE, AGENT_FILE):
            os.replace(Path(temporary, name), directory / name)
    return directory


def load_agent(
    directory: str | os.PathLike[str],
    *,
    planner: bool = True,
    task: str | Task | None = None,
    device: torch.device | str | None = None,
    compile: bool | dict[str, Any] = False,
) -> Agent:
    """Load a saved agent, ready to act.

    Nothing in the files is executed, and no memory is taken for weights before they are
    known to fit.

    Args:
        directory: where :func:`save_agent` wrote it.
        planner: whether it plans; ``False`` is the actor alone.
        task: the task it must be for; one that is not registered can be given itself.
        device: where it acts. Defaults to the CPU.
        compile: whether to compile the plan.

    Raises:
        AgentError: if a file is missing, damaged, of another version or another task.

    Examples:
        >>> import tempfile
        >>> from phihp_torchrl import get_task, load_agent
        >>> from phihp_torchrl.agents.networks import Actor
        >>> from phihp_torchrl.deployment import Agent, save_agent
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
    _check_format(path, content)
    blueprint = read_blueprint(path, content)
    task = _resolve_task(path, blueprint.task, task)
    weights = _read_weights(directory / WEIGHTS_FILE, blueprint, task, content)
    device = _check_device(device)
    try:
        parts = blueprint.build_modules(task)
        for name, part in parts.items():
            start = f"{name}."
            own = {k.removeprefix(start): t for k, t in weights.items() if k.startswith(start)}
            part.load_state_dict(own)
            part.to(device).requires_grad_(False).eval()
        return blueprint.assemble(
            task,
            parts,
            use_planner=planner,
            compile=compile,
            metadata=content["metadata"],
        )
    except (ValueError, TypeError, RuntimeError) as error:
        raise AgentError(f"{path}: the agent can not be built: {error}") from error


def _check_format(path: Path, content: dict[str, Any]) -> None:
    if content.get("format") != FORMAT:
        raise AgentError(f"{path}: expected format {FORMAT!r}, got {content.get('format')!r}.")
    version = content.get("format_version")
    if version != FORMAT_VERSION:
        raise AgentError(
            f"{path}: expected format_version {FORMAT_VERSION}, got {version!r}; it was "
            f"written by version {content.get('package_version')!r} of this package, here is "
            f"{_package_version()}."
        )
    if not isinstance(content.get("metadata"), dict):
        raise AgentError(
            f"{path}: metadata: expected a JSON object, got {content.get('metadata')!r}."
        )


def _resolve_task(path: Path, saved: TaskSignature, wanted: str | Task | None) -> Task:
    if not isinstance(saved.name, str):
        raise AgentError(f"{path}: task.name: expected a text, got {saved.name!r}.")
    name = wanted.name if isinstance(wanted, Task) else wanted
    if name is not None and name != saved.name:
        raise AgentError(
            f"{path}: expected an agent for task {name!r}, got one for {saved.name!r}."
        )
    try:
        task = wanted if isinstance(wanted, Task) else get_task(saved.name)
    except ValueError as error:
        raise AgentError(f"{path}: {error} Register it first, or pass it as task.") from error
    for field in fields(TaskSignature):
        here, there = (getattr(s, field.name) for s in (TaskSignature.of(task), saved))
        if here != there:
            raise AgentError(
                f"{path}: task {saved.name!r} is another one here: expected its {field.name} "
                f"{here!r}, got {there!r}."
            )
    return task


def _read_weights(
    path: Path, blueprint: AnyBlueprint, task: Task, content: dict[str, Any]
) -> dict[str, Tensor]:
    agent_path = path.with_name(AGENT_FILE)
    try:
        with torch.device("meta"):  # shapes without memory
            parts = blueprint.build_modules(task)
    except (ValueError, TypeError, RuntimeError) as error:
        raise AgentError(f"{agent_path}: {error}") from error
    weights, data = read_weights(path, _tensors(parts))
    for name, tensor in weights.items():
        if name.endswith(".action_high") and tensor.tolist() != list(task.action_high):
            raise AgentError(
                f"{path}: {name}: expected the task's {task.action_high}, got {tensor.tolist()}."
            )
    if hashlib.sha256(data).hexdigest() != content.get("weights_sha256"):
        raise AgentError(
            f"{path}: expected the weights that {AGENT_FILE} was written with, got others; "
            "were the files copied from two agents, or was a saving interrupted?"
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


def _package_version() -> str:
    from phihp_torchrl import __version__

    return __version__
