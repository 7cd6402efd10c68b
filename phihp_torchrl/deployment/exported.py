"""Exported agents, loaded again: they act as agents do, without their parts."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from phihp_torchrl.config import ConfigError, from_mapping
from phihp_torchrl.deployment.manifest import Manifest, signature_of
from phihp_torchrl.deployment.reading import AgentError
from phihp_torchrl.tasks import Actuator, Task, find_task

Act = Callable[..., Tensor]
"""A function from observation ``[o]``, and noise if there is some, to an action ``[m]``."""


class ExportedAgent(TensorDictModuleBase):
    """An exported plan or actor, which reads ``"observation"`` ``[o]`` and writes ``"action"``.

    It acts for one observation of the task at a time, and keeps nothing between steps. A
    :class:`~phihp_torchrl.deployment.Controller` adds what is under way in an actuator.

    Args:
        act: the function in the file.
        task: the task.
        noise_shape: shape of the standard normal noise that it takes, or ``None``.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> agent = ExportedAgent(lambda o: o[:1], get_task("pendulum"))
        >>> agent(TensorDict(observation=torch.tensor([0.5, 0.0, 0.0])))["action"]
        tensor([0.5000])
    """

    def __init__(self, act: Act, task: Task, noise_shape: tuple[int, ...] | None = None) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], ["action"]
        self.task, self._act, self._noise_shape = task, act, noise_shape

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"action"`` ``[m]``.

        Raises:
            ValueError: for an observation of another shape than ``[o]``, or not finite.
        """
        observation = tensordict["observation"]
        shape = [self.task.observation_dim]
        if list(observation.shape) != shape or not observation.isfinite().all():
            raise ValueError(
                f"observation: expected finite numbers of shape {shape}, "
                f"got shape {list(observation.shape)} of {observation.tolist()}."
            )
        noise = () if self._noise_shape is None else (torch.randn(self._noise_shape),)
        with torch.no_grad():
            return tensordict.set("action", self._act(observation, *noise))


def load_exported(path: str | os.PathLike[str], task: str | Task | None = None) -> ExportedAgent:
    """Load an exported plan or actor: an AOTInductor package (``.pt2``) or an ONNX model.

    The description beside the file is checked first: its digest, and for machine code the version
    of torch and the processor. A package is native code, so load only what you trust.

    Args:
        path: the file that ``phihp export`` wrote, with its description ``.json`` beside it.
        task: the task or its name. Defaults to the registered one that the description names.

    Raises:
        AgentError: if a file is missing or another one, or does not run here.
        ImportError: if ONNX Runtime is not installed.

    Examples:
        >>> agent = load_exported("outputs/export/plan.pt2")  # doctest: +SKIP
        >>> try:
        ...     load_exported("no/such/plan.pt2")
        ... except AgentError as error:
        ...     print(error)
        no/such/plan.pt2: expected an exported file, found none.
    """
    path = Path(path)
    if not path.is_file():
        raise AgentError(f"{path}: expected an exported file, found none.")
    if path.suffix not in _LOADERS:
        raise AgentError(f"{path}: expected one of {list(_LOADERS)}, got {path.suffix!r}.")
    manifest = Manifest.read(path)
    manifest.check(path, machine_code=path.suffix == ".pt2")
    try:
        here = find_task(manifest.task["name"] if task is None else task)
        actuator = from_mapping(Actuator, manifest.actuator) if manifest.actuator else None
    except (ConfigError, KeyError) as error:
        raise AgentError(f"{path}: {error} Register the task first, or pass it as task.") from error
    here = replace(here, actuator=actuator)
    signature = signature_of(here)
    if signature != dict(manifest.task):
        differing = sorted(k for k, v in signature.items() if manifest.task.get(k) != v)
        raise AgentError(f"{path}: task {here.name!r} is another one here: {differing} differ.")
    return ExportedAgent(_LOADERS[path.suffix](path), here, manifest.noise)


def load_aoti(path: Path) -> Act:
    """The function in an AOTInductor package."""
    return torch._inductor.aoti_load_package(str(path))


def import_onnx(name: str) -> Any:
    """Import a library of the extra ``onnx``.

    Raises:
        ImportError: if it is not installed; the message says how to install it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{error.name}: expected it for ONNX, it is not installed; "
            "`pip install 'phihp_torchrl[onnx]'` brings it."
        ) from error


def load_onnx(path: Path) -> Act:
    """The function in an ONNX model, run by ONNX Runtime.

    Raises:
        ImportError: if ONNX Runtime is not installed.
    """
    onnxruntime = import_onnx("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(str(path), options)
    names = [each.name for each in session.get_inputs()]

    def act(*inputs: Tensor) -> Tensor:
        arrays = {name: each.numpy() for name, each in zip(names, inputs, strict=True)}
        return torch.from_numpy(session.run(["action"], arrays)[0])

    return act


_LOADERS = {".pt2": load_aoti, ".onnx": load_onnx}
