"""Matrix products of compiled graphs, each by the faster of two libraries on the machine at hand.

On a CPU, ATen hands products of float32 matrices to its BLAS. With 64 to thousands of rows and
layers of 100 to 300 units, which are the sizes met here, oneDNN is faster on some processors and
slower on others. So each product is timed once by both, which takes some milliseconds, when a graph
that has it is compiled. The compiler's cache keeps what was chosen.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, fx
from torch._inductor.custom_graph_pass import CustomGraphPass, get_hash_for_files
from torch._inductor.virtualized import V
from torch._subclasses.fake_tensor import unset_fake_temporarily

from phihp_torchrl.origin import processor_name

_aten = torch.ops.aten
# Products of fewer multiplications stay with the BLAS, because calling oneDNN costs more than its
# kernel saves: 32 rows through a layer of 300 units are faster by the BLAS, 64 may be by oneDNN.
_FEWEST = 2**22
# Each is timed so often, in turns. oneDNN gets a product that it does in at most this share of the
# BLAS's time: where both are about as fast, noise should not decide.
_ROUNDS, _SHARE = 7, 0.95

torch.library.define(
    "phihp_torchrl::linear", "(Tensor input, Tensor weight, Tensor? bias, bool relu) -> Tensor"
)


@torch.library.register_fake("phihp_torchrl::linear")
def _(input: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    return input.new_empty(input.shape[0], weight.shape[0])


@torch.library.impl("phihp_torchrl::linear", "CPU")
def _linear(input: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    """``input @ weight.T + bias`` by oneDNN; either matrix may be a transposed view."""
    attribute = "relu" if relu else "none"
    return torch.ops.mkldnn._linear_pointwise.default(input, weight, bias, attribute, [], "")


class Product(NamedTuple):
    """A product of two matrices as it stands in a graph.

    Attributes:
        left: sizes and strides of the first matrix.
        right: of the second one.
        dtype: of both.
        bias: whether a bias is added.
        relu: whether a ReLU follows.
        turned: whether its transpose is what is used.
    """

    left: tuple[tuple[int, ...], tuple[int, ...]]
    right: tuple[tuple[int, ...], tuple[int, ...]]
    dtype: torch.dtype
    bias: bool = False
    relu: bool = False
    turned: bool = False


def by_onednn(a: Tensor, b: Tensor, bias: Tensor | None, product: Product) -> Tensor:
    """``a @ b + bias``, or its transpose, with an optional ReLU, by oneDNN on the CPU."""
    linear = torch.ops.phihp_torchrl.linear.default
    return linear(b.t(), a, None, False) if product.turned else linear(a, b.t(), bias, product.relu)


def by_blas(a: Tensor, b: Tensor, bias: Tensor | None, product: Product) -> Tensor:
    """The same, not transposed, by ATen, which asks its BLAS."""
    found = torch.mm(a, b) if bias is None else torch.addmm(bias, a, b)
    return found.relu_() if product.relu else found


@functools.cache
def onednn_is_faster(product: Product, threads: int) -> bool:
    """Whether oneDNN is the faster one for a product, by a measurement on this machine's CPU.

    Args:
        product: the product, in the layout in which it is computed.
        threads: threads of an operation, ``torch.get_num_threads()``.

    Returns:
        Whether its fastest call took at most 95 % of the BLAS's. A second call with the same
        arguments does not measure again.

    Examples:
        >>> product = Product(((64, 300), (300, 1)), ((300, 300), (1, 300)), torch.float32)
        >>> onednn_is_faster(product, torch.get_num_threads()) in (True, False)
        True
    """
    with unset_fake_temporarily(), torch.inference_mode():
        a, b = (
            torch.empty_strided(*layout, dtype=product.dtype, device="cpu").fill_(1.0)
            for layout in (product.left, product.right)
        )
        bias = torch.ones(b.shape[1], dtype=product.dtype, device="cpu") if product.bias else None
        blas, onednn = (functools.partial(by, a, b, bias, product) for by in (by_blas, by_onednn))
        pairs = [(_seconds(blas), _seconds(onednn)) for _ in range(_ROUNDS)]
    theirs, ours = (min(times) for times in zip(*pairs, strict=True))
    return ours <= _SHARE * theirs


def _seconds(call: Callable[[], Tensor]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


class FasterProducts(CustomGraphPass):
    """Gives matrix products on the CPU to oneDNN, with bias and ReLU, where that is faster."""

    def __call__(self, graph: fx.Graph) -> None:
        node: Any
        for node in list(graph.nodes):
            if not _is_eligible(node):
                continue
            *added, a, b = node.args
            users = list(node.users)
            # The gradient of a weight is computed in the transposed form in which it is used.
            turned = not added and bool(users) and all(map(_is_transposition, users))
            relu = not turned and len(users) == 1 and users[0].target is _aten.relu.default
            layouts = (_layout(a), _layout(b))
            asked = Product(*layouts, a.meta["val"].dtype, bool(added), relu, turned)
            if not onednn_is_faster(asked, torch.get_num_threads()):
                continue
            with graph.inserting_before(node):
                if turned:
                    product = _insert_linear(graph, _transposed(graph, b), a)
                else:
                    bias = added[0] if added else None
                    product = _insert_linear(graph, a, _transposed(graph, b), bias, relu)
                    users = users if relu else [node]
            for user in users:
                user.replace_all_uses_with(product)
                graph.erase_node(user)
            if node not in users:
                graph.erase_node(node)

    def uuid(self) -> bytes:
        # What was measured holds for such a machine, and so does a graph in the compiler's cache.
        machine = processor_name(), torch.backends.cpu.get_cpu_capability()
        return get_hash_for_files((__file__,), f"{machine} {torch.get_num_threads()}")


def _is_eligible(node: Any) -> bool:
    if node.op != "call_function" or node.target not in (_aten.mm.default, _aten.addmm.default):
        return False
    *added, a, b = [argument.meta["val"] for argument in node.args]
    rows, inner, columns = a.shape[0], a.shape[1], b.shape[1]
    return (
        torch.backends.mkldnn.is_available()
        and a.device.type == "cpu"
        and a.dtype in _dtypes()
        and all(isinstance(size, int) for size in (rows, inner, columns))
        and columns > 1
        and rows * inner * columns >= _FEWEST
        and all(bias.shape == (columns,) for bias in added)
        and all(node.kwargs.get(name, 1) == 1 for name in ("alpha", "beta"))
    )


def _layout(node: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Sizes and strides of a matrix."""
    matrix = node.meta["val"]
    return tuple(matrix.shape), tuple(matrix.stride())


def _dtypes() -> tuple[torch.dtype, ...]:
    """What oneDNN multiplies here: on processors without AVX-512 it has no bfloat16."""
    if torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return torch.float32, torch.bfloat16
    return (torch.float32,)


def _is_transposition(node: Any) -> bool:
    return node.target is _aten.permute.default and [dim % 2 for dim in node.args[1]] == [1, 0]


def _transposed(graph: fx.Graph, node: Any) -> fx.Node:
    if _is_transposition(node):
        return node.args[0]
    return _insert(graph, _aten.permute.default, node, [1, 0])


def _insert_linear(
    graph: fx.Graph, a: fx.Node, weight: fx.Node, bias: fx.Node | None = None, relu: bool = False
) -> fx.Node:
    return _insert(graph, torch.ops.phihp_torchrl.linear.default, a, weight, bias, relu)


def _insert(graph: fx.Graph, target: Any, *args: Any) -> fx.Node:
    node = graph.call_function(target, args)
    with V.fake_mode:
        node.meta["val"] = target(*fx.map_arg(args, lambda argument: argument.meta["val"]))
    return node
