"""A step of the dynamics as one graph, for states of any number of rows."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from phihp_torchrl.compilation import compile_graph

Step = Callable[[Tensor, Tensor], Tensor]

_FEWEST_ROWS = 2
"""Of fewer rows the compiler would make a graph of their own."""


class CompiledStep:
    """Compiles a step at its first call, once for all numbers of rows.

    A graph of a whole plan or of a chunk of imagination has the step many times over. This one has
    it once, so that it compiles sooner, in proportion, and all of them call it. It pays where a
    step has hundreds of operations, as with Runge-Kutta and substeps: 192 rows of a cart-pole, at
    two substeps of RK4, take 2.4 times as long without it (``benchmarks/speed/compiling.py``).

    Args:
        step: ``(state [rows, n], action [rows, m]) -> next state [rows, n]``. Weights that it
            closes over may change in place.

    Examples:
        >>> double = CompiledStep(lambda state, action: 2 * state + action)
        >>> [double(torch.ones(rows, 2), torch.zeros(rows, 1)).shape[0] for rows in (3, 1)]
        [3, 1]
    """

    def __init__(self, step: Step) -> None:
        # All is static but the rows, which are marked: "dynamic=True" would make variables of the
        # numbers in systems too, by which their equations branch.
        self._step: Step = compile_graph(step, cpp_wrapper=True)
        self._seen: set[tuple[torch.dtype, torch.device]] = set()

    def __call__(self, state: Tensor, action: Tensor) -> Tensor:
        rows = len(state)
        if rows < _FEWEST_ROWS:
            state, action = (each.expand(_FEWEST_ROWS, -1) for each in (state, action))
        state, action = state.contiguous(), action.contiguous()
        kind = (state.dtype, state.device)
        if kind not in self._seen:
            self._seen.add(kind)
            for each in (state, action):
                torch._dynamo.mark_dynamic(each, 0)
        return self._step(state, action)[:rows]


def count_operations(step: Step, state: Tensor, action: Tensor) -> int:
    """Number of tensor operations that a step calls without gradients.

    Args:
        step: the step.
        state: states ``[rows, n]`` to call it with.
        action: actions ``[rows, m]``.

    Examples:
        >>> count_operations(lambda s, a: s + 2 * a, torch.ones(2, 1), torch.ones(2, 1))
        2
    """
    with torch.no_grad(), _Counter() as counter:
        step(state, action)
    return counter.count


class _Counter(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        self.count += 1
        return func(*args, **(kwargs or {}))
