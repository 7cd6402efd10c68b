"""A dry run of a task: its functions on a few states, before anything is done with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks.base import Task

_ROWS = 6


def check_functions(task: Task) -> None:
    """Call all functions of a task and of its system, and compare what comes with what should.

    Each is called for a few start states in a batch ``[6]``, in a batch ``[2, 3]`` and one by one.
    Shape, dtype and device must be right, numbers finite, each row the same in every batch, and
    what a function is given must stay as it is, for others read it too.

    Args:
        task: the task.

    Raises:
        ConfigError: for the first function that fails or returns something else; the message names
            it, what was expected and what came.
    """
    system, name = task.system, type(task.system).__name__
    if not isinstance(getattr(system, "ranges", None), dict):
        raise ConfigError(
            "system",
            f"expected {name}.__init__ to call super().__init__(constants), which reads the "
            "constants; it does not.",
        )
    generator = torch.Generator().manual_seed(0)
    state = task.sample_start([_ROWS], generator)
    unit = 2.0 * torch.rand(_ROWS, task.action_dim, generator=generator) - 1.0
    physical, registers = task.split(state)
    command = task.command(registers, task.bounds.from_unit(unit))
    acting, after = task.acting(registers, command)
    following = torch.cat([physical, after], -1)
    check = _Check(state.dtype)
    seen = check(f"{name}.observe", system.observe, (physical,), (system.observation_dim,))
    found = check(f"{name}.locate", system.locate, (seen,), (system.state_dim,))
    if not torch.allclose(system.difference(found, physical), torch.zeros(()), atol=1e-4):
        raise ConfigError(
            f"{name}.locate",
            f"expected the state that {name}.observe shows, {physical[0].tolist()}, "
            f"got {found[0].tolist()}.",
        )
    if system.has_prior:
        prior = lambda s, a: system.prior(s, a, system.constants)  # noqa: E731
        check(f"{name}.prior", prior, (physical, acting), (system.state_dim,))
    three = (state, command, following)
    check(f"reward, {_named(task.reward)}", task.earned, three)
    if task.exploration_reward is not None:
        explore = _with_reward(task)
        key = f"exploration_reward, {_named(task.exploration_reward)}"
        check(key, explore.earned, three)
    if task.limits:
        check("constraints", lambda s, a, n: task.price(s, a, n), three, none=True)
    if task.terminated is not None:
        key = f"terminated, {_named(task.terminated)}"
        check(key, task.is_terminated, (following, command), dtype=torch.bool)


class _Check:
    """Calls functions of tensors in several batches.

    Args:
        dtype: the dtype of the states.
    """

    def __init__(self, dtype: torch.dtype) -> None:
        self.dtype = dtype

    def __call__(
        self,
        key: str,
        function: Callable[..., Any],
        arguments: tuple[Tensor, ...],
        size: tuple[int, ...] = (),
        *,
        dtype: torch.dtype | None = None,
        none: bool = False,
    ) -> Tensor:
        """Return what a function gives for the batch ``[6]``, which is ``[6, *size]``."""
        dtype = dtype or self.dtype
        given = self._call(key, function, arguments, (_ROWS, *size), dtype, none)
        if given is None:
            return arguments[0]
        wide = [argument.reshape(2, 3, *argument.shape[1:]) for argument in arguments]
        wider = self._call(key, function, tuple(wide), (2, 3, *size), dtype, none)
        for row in range(_ROWS):
            one = tuple(argument[row] for argument in arguments)
            alone = self._call(key, function, one, size, dtype, none)
            for other in (alone, wider.reshape(given.shape)[row]):
                if not torch.allclose(other.double(), given[row].double(), rtol=1e-3, atol=1e-5):
                    raise ConfigError(
                        key,
                        "expected the same for a state alone as in a batch, got "
                        f"{other.tolist()} and {given[row].tolist()}; rows must not mix.",
                    )
        return given

    def _call(
        self,
        key: str,
        function: Callable[..., Any],
        arguments: tuple[Tensor, ...],
        shape: tuple[int, ...],
        dtype: torch.dtype,
        none: bool,
    ) -> Any:
        shapes = ", ".join(str(list(argument.shape)) for argument in arguments)
        before = [argument.clone() for argument in arguments]
        try:
            with torch.no_grad():
                given = function(*arguments)
        except ConfigError:
            raise
        # A user's function may raise anything; the message should name it and the reason.
        except Exception as error:
            raise ConfigError(
                key, f"it failed for tensors of shape {shapes}: {type(error).__name__}: {error}"
            ) from error
        for number, (argument, kept) in enumerate(zip(arguments, before, strict=True), 1):
            if not torch.equal(argument, kept):
                raise ConfigError(
                    key,
                    f"expected it to leave what it is given as it is, it changed argument {number} "
                    f"of {len(arguments)} in place; compute with new tensors.",
                )
        if given is None and none:
            return None
        kind = str(dtype).removeprefix("torch.")
        expected = f"expected {kind} of shape {list(shape)} for tensors of shape {shapes}"
        if not isinstance(given, Tensor):
            raise ConfigError(key, f"{expected}, got {type(given).__name__} {given!r:.60}.")
        if given.shape != shape or given.dtype != dtype:
            got = str(given.dtype).removeprefix("torch.")
            raise ConfigError(key, f"{expected}, got {got} of shape {list(given.shape)}.")
        if given.device != arguments[0].device:
            raise ConfigError(
                key, f"expected a tensor on {arguments[0].device}, got one on {given.device}."
            )
        if not given.isfinite().all():
            raise ConfigError(
                key, f"expected finite numbers, got {given.tolist()} for {arguments[0].tolist()}."
            )
        return given


def _with_reward(task: Task) -> Task:
    assert task.exploration_reward is not None
    return replace(task, reward=task.exploration_reward, exploration_reward=task.reward)


def _named(function: Callable[..., Any]) -> str:
    return getattr(function, "__name__", type(function).__name__)
