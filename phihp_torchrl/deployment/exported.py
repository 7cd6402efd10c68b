"""Exported agents, loaded again: they act as agents do, without their parts."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment.export_modules import LAST, PLAN, action_of
from phihp_torchrl.deployment.manifest import Manifest
from phihp_torchrl.deployment.reading import AgentError
from phihp_torchrl.deployment.saved_task import another_task, find_task, read_signature
from phihp_torchrl.tasks import Task

Act = Callable[..., Any]
"""A function from observation ``[o]``, noise and memory, as far as there are some, to an action
``[m]``, or to it and the plan to go on from."""


class ExportedAgent(TensorDictModuleBase):
    """An exported plan or actor, which reads ``"observation"`` ``[o]`` and writes ``"action"``.

    It acts for one observation of the task at a time, and keeps what a plan goes on from in the
    next step, which ``"is_init"`` or :meth:`reset` forget. A
    :class:`~phihp_torchrl.deployment.Controller` adds what is under way in an actuator.

    Args:
        act: the function in the file.
        task: the task.
        noise_shape: shape of the standard normal noise that it takes, or ``None``.
        memory: what it keeps from step to step, with the values where an episode starts.

    Examples:
        >>> from tensordict import TensorDict
        >>> from phihp_torchrl import get_task
        >>> agent = ExportedAgent(lambda o: o[:1], get_task("pendulum"))
        >>> agent(TensorDict(observation=torch.tensor([0.5, 0.0, 0.0])))["action"]
        tensor([0.5000])
    """

    def __init__(
        self,
        act: Act,
        task: Task,
        noise_shape: tuple[int, ...] | None = None,
        memory: Mapping[str, Tensor] | None = None,
    ) -> None:
        super().__init__()
        self._starts = dict(memory or {})
        self.in_keys, self.out_keys = ["observation"], ["action"]
        if self._starts:
            self.in_keys.append("is_init")
        self.task, self._act, self._noise_shape = task, act, noise_shape
        self.reset()

    def reset(self) -> None:
        """Forget what is kept, at the start of an episode."""
        self._memory = dict(self._starts)

    def follow(self, sent: Tensor, missed: int = 0) -> None:
        """Go on from what was sent since it last acted, as :meth:`phihp_torchrl.Agent.follow`."""
        self._keep(sent)
        if missed and (plan := self._memory.get(PLAN)) is not None:
            self._memory[PLAN] = torch.cat([plan[missed:], self._starts[PLAN][:missed]])

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
        if (starts := tensordict.get("is_init", None)) is not None and starts.any():
            self.reset()
        noise = () if self._noise_shape is None else (torch.randn(self._noise_shape),)
        with torch.no_grad():
            found = self._act(observation, *noise, *self._memory.values())
        action = action_of(found)
        self._keep(action)
        if PLAN in self._memory:
            self._memory[PLAN] = found[1]
        return tensordict.set("action", action)

    def _keep(self, action: Tensor) -> None:
        if LAST in self._memory:
            self._memory[LAST] = action.clone()


def load_exported(path: str | os.PathLike[str], task: str | Task | None = None) -> ExportedAgent:
    """Load an exported plan or actor: an AOTInductor package (``.pt2``) or an ONNX model.

    The description beside the file is checked first: its digest, and for machine code the version
    of torch and the processor. It also has what the agent was trained with: a registered task gets
    the actuator, the rates and the constraints from it, and has to agree in the range and preview
    of its reference. A package is native code, so load only what you trust.

    Args:
        path: the file that ``phihp export`` wrote, with its description ``.json`` beside it.
        task: the task that it must be for, or its name. Defaults to the registered one that the
            description names.

    Raises:
        AgentError: if a file is missing or another one, is for another task, or does not run here.
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
    task = _task_of(path, manifest, task)
    return ExportedAgent(_LOADERS[path.suffix](path), task, manifest.noise, manifest.starts())


def _task_of(path: Path, manifest: Manifest, wanted: str | Task | None) -> Task:
    """The task of an exported file, with all that its agent was trained with."""
    try:
        signature = read_signature(manifest.task)
    except ConfigError as error:
        raise AgentError(f"{path}: {error}") from error
    partial = manifest.format_version == 1
    task = find_task(path, signature, wanted, manifest.additions, partial=partial)
    if task.observation_dim != manifest.observation:
        raise another_task(
            path, task, f"observations of {manifest.observation} numbers", task.observation_dim
        )
    return task


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

    def act(*inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        arrays = {name: each.numpy() for name, each in zip(names, inputs, strict=True)}
        found = tuple(map(torch.from_numpy, session.run(None, arrays)))
        return found if len(found) > 1 else found[0]

    return act


_LOADERS = {".pt2": load_aoti, ".onnx": load_onnx}
