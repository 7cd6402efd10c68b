"""The plan of a planner as functions, one for each set of shapes where it is compiled."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

from torch import Tensor

_MOST = 32


class PlanFunctions:
    """Keeps a planner's plan as a function; compiled, one for each set of shapes that was met.

    Of compiled ones the ``32`` that were called last are kept. A graph depends on how its inputs
    lie in memory too, so they are laid out in one way before a call, and slices, transposed tensors
    and views of others share one graph.

    Examples:
        >>> import torch
        >>> functions, built = PlanFunctions(), []
        >>> def build():
        ...     built.append(1)
        ...     return lambda observation: observation.stride()
        >>> wide = torch.zeros(3, 8)
        >>> [functions.call(build, True, wide[:, ::step][:, :2]) for step in (1, 2, 4)], built
        ([(2, 1), (2, 1), (2, 1)], [1])
    """

    def __init__(self) -> None:
        self._functions: OrderedDict[Hashable, Callable[..., Any]] = OrderedDict()
        self._replaced: dict[Hashable, Callable[..., Any]] = {}

    def __len__(self) -> int:
        return len(self._functions)

    def clear(self) -> None:
        """Forget all, so that the next call builds anew."""
        self._functions.clear()
        self._replaced.clear()

    def replace(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Call another function, made ahead, for arguments of the same shapes as these."""
        self._replaced[_each(arguments, _signature)] = function

    def is_replaced(self, *arguments: Any) -> bool:
        """Whether another function that is up to date is called for such arguments."""
        found = self._replaced.get(_each(arguments, _signature))
        return found is not None and getattr(found, "is_current", True)

    def call(
        self, build: Callable[[], Callable[..., Any]], compiled: bool, observation: Any, *args: Any
    ) -> Any:
        """Call the function for these arguments, which ``build`` makes if there is none yet.

        Args:
            build: makes the plan as a function, compiled or not.
            compiled: whether it makes a compiled one.
            observation: the first argument.
            args: the other arguments: tensors, ``None`` and named tuples of tensors.
        """
        shapes, inputs = None, (observation, *args)
        if compiled or self._replaced:
            inputs = _each(inputs, _laid_out)
            shapes = _each(inputs, _signature)
            if shapes in self._replaced:
                return self._replaced[shapes](*inputs)
        if not compiled:
            if None not in self._functions:
                self._functions[None] = build()
            return self._functions[None](*inputs)
        function = self._functions.pop(shapes, None) or build()
        self._functions[shapes] = function  # as the last one
        if len(self._functions) > _MOST:
            self._functions.popitem(last=False)
        return function(*inputs)


def _each(arguments: Any, change: Callable[[Tensor], Any]) -> Any:
    """Change every tensor in nested tuples."""
    if isinstance(arguments, tuple):
        changed = [_each(part, change) for part in arguments]
        named = hasattr(arguments, "_fields")
        return type(arguments)(*changed) if named else tuple(changed)
    return change(arguments) if isinstance(arguments, Tensor) else arguments


def _signature(tensor: Tensor) -> Hashable:
    return tensor.shape, tensor.dtype, tensor.device


def _laid_out(tensor: Tensor) -> Tensor:
    """The same numbers with the strides of a new tensor, also along dimensions of size one."""
    strides, size = [], 1
    for length in reversed(tensor.shape):
        strides.append(size)
        size *= max(length, 1)
    if tensor.stride() == (usual := tuple(reversed(strides))):
        return tensor
    return tensor.contiguous().as_strided(tensor.shape, usual)
