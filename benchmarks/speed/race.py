"""Contenders timed in turn, so that whatever else the machine does hits all of them alike.

Time is that of the thread, which stands still while another process has the core.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from statistics import median

import torch

Shape = tuple[int, int, int]
"""Rows, inner and columns of a product of matrices."""


def race(
    benchmark, contenders: dict[str, Callable[[], object]], rounds: int
) -> dict[str, list[float]]:
    """Milliseconds of each contender in each round; pytest-benchmark times the rounds."""
    milliseconds: dict[str, list[float]] = {name: [] for name in contenders}

    def one_round():
        for name, contender in contenders.items():
            contender()  # what the others left in the caches is not its fault
            start = time.thread_time()
            contender()
            milliseconds[name].append(1e3 * (time.thread_time() - start))

    with torch.no_grad():
        for contender in contenders.values():
            contender()
        benchmark.pedantic(one_round, rounds=rounds)
    return milliseconds


def figures(
    milliseconds: dict[str, list[float]], work: float = 1.0
) -> list[dict[str, float | str]]:
    """A row for each contender: its median, and the median over rounds of its ratio to the first.

    Args:
        milliseconds: what :func:`race` returns.
        work: pieces of work in a call, of which the median is shown.
    """
    ours = next(iter(milliseconds.values()))
    return [
        {
            "contender": name,
            "ms": median(times) / work,
            "ratio": median(a / b for a, b in zip(times, ours, strict=True)),
        }
        for name, times in milliseconds.items()
    ]


def products(shapes: Sequence[Shape]) -> Callable[[], object]:
    """The products of these shapes by ``torch.mm``, operands at hand: the arithmetic alone."""
    operands = [(torch.randn(m, k), torch.randn(k, n)) for m, k, n in shapes]
    return lambda: [torch.mm(a, b) for a, b in operands]


def layers_of(sizes: Sequence[int]) -> list[tuple[int, int]]:
    """Inputs and outputs of each layer of a network."""
    return list(itertools.pairwise(sizes))


def forward(rows: int, sizes: Sequence[int]) -> list[Shape]:
    """Products of a network's evaluation."""
    return [(rows, i, o) for i, o in layers_of(sizes)]


def backward(rows: int, sizes: Sequence[int], weights: bool = True) -> list[Shape]:
    """Products of its gradients: of the weights, and of what each layer is given but the first."""
    shapes = []
    for position, (i, o) in enumerate(layers_of(sizes)):
        shapes += [(i, rows, o)] if weights else []
        shapes += [(rows, o, i)] if position or not weights else []
    return shapes
