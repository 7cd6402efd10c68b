"""Compilation of the time-critical functions: one full graph each, matrix products by oneDNN.

On a CPU, ATen hands products of float32 matrices to its BLAS. At most of the sizes met here, 64 to
thousands of rows through layers of 200 to 300 units, oneDNN is faster on processors for which that
BLAS has no AVX-512 kernels (``make bench`` prints the ratio to ``torch.mm``). ATen uses oneDNN for
reduced precision only, so the compiler is told here to use it for float32 as well.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor, fx, nn
from torch._C._dynamo.eval_frame import reset_code
from torch._inductor.custom_graph_pass import CustomGraphPass, get_hash_for_files
from torch._inductor.virtualized import V

P = ParamSpec("P")
R = TypeVar("R")

_aten = torch.ops.aten
# Products of fewer multiplications stay with the BLAS, because calling oneDNN costs more than its
# kernel saves: 32 rows through a layer of 300 units are faster by the BLAS, 64 by oneDNN.
_FEWEST = 2**22

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


def compile_graph(
    function: Callable[P, R], *, enabled: bool = True, cpp_wrapper: bool = False, **options: Any
) -> Callable[P, R]:
    """Compile a pure function of tensors as one graph; a graph break raises an error.

    Shapes are static: each combination of shapes has a separate graph, which is compiled at the
    first call with these shapes. That takes 10 to 40 s, or 1 to 3 s from the compiler's cache on
    disk. The number of graphs is limited for each compiled function and not for all of them
    together, so any number of agents may compile the same function in a process. Graphs are
    released with the function that is returned, and the memory of a dropped agent with them.

    Each call compares the arguments and the training modes of modules with those that the graph
    was compiled for. It does not compare everything else that the function closes over, because
    checking hundreds of attributes takes a good part of a small plan's time.

    Args:
        function: the function to compile. Whatever it closes over is a constant of the graph,
            except tensors that are changed in place and training modes of modules; compile again
            after other changes.
        enabled: ``False`` returns the function unchanged.
        cpp_wrapper: whether to call the kernels from C++ instead of Python. Compilation takes
            longer, a call of many small kernels less time.
        options: options of :func:`torch.compile`; they override those that are set here.

    Examples:
        >>> double = compile_graph(lambda x: 2 * x, backend="eager")
        >>> double(torch.ones(2))
        tensor([2., 2.])
    """
    if not enabled:
        return function

    def graph(*args: P.args, **kwargs: P.kwargs) -> R:
        return function(*args, **kwargs)

    # Dynamo counts graphs per code object, which all closures made here would otherwise share.
    graph.__code__ = graph.__code__.replace()
    # Its table from compiled to original code keeps both, with the graphs and kernels, for good.
    weakref.finalize(graph, reset_code, graph.__code__).atexit = False
    if "mode" not in options:  # the compiler takes a mode or options
        ours: dict[str, Any] = {"guard_filter_fn": _guards_to_keep}
        if options.get("backend", "inductor") == "inductor":
            ours["cpp_wrapper"] = cpp_wrapper
            if torch.backends.mkldnn.is_available():
                ours["post_grad_custom_post_pass"] = _MatricesByOneDNN()
        options["options"] = {**ours, **options.get("options", {})}
    defaults: dict[str, Any] = {"fullgraph": True, "dynamic": False}
    return torch.compile(graph, **{**defaults, **options})


def compile_ahead(module: nn.Module, arguments: tuple[Tensor, ...], path: str | Path) -> None:
    """Compile a call of a module, with its weights, into a package of AOTInductor.

    The compiler's headers are not precompiled for it: that takes long, and pays only on a machine
    that makes many packages.

    Args:
        module: the module.
        arguments: an example of its arguments, whose shapes the package takes.
        path: the file to write, ending in ``.pt2``.
    """
    with torch.no_grad():
        program = torch.export.export(module, arguments)
        torch._inductor.aoti_compile_and_package(
            program,
            package_path=str(path),
            inductor_configs={
                "aot_inductor.precompile_headers": False,
                "cpp_cache_precompile_headers": False,
            },
        )


def _guards_to_keep(guards: Sequence[Any]) -> list[bool]:
    """Keep the guards on arguments and torch's state, which have no name, and on training modes."""
    return [
        guard.name.endswith(".training")
        or not (guard.is_global or guard.name.startswith("function"))  # as `graph` names it
        for guard in guards
    ]


class _MatricesByOneDNN(CustomGraphPass):
    """Replaces the larger matrix products on the CPU, with their bias and a ReLU that follows."""

    def __call__(self, graph: fx.Graph) -> None:
        node: Any
        for node in list(graph.nodes):
            if not _is_eligible(node):
                continue
            *added, a, b = node.args
            with graph.inserting_before(node):
                users = list(node.users)
                if not added and users and all(map(_is_transposition, users)):
                    # The gradient of a weight, computed in the transposed form in which it is used.
                    product = _insert_linear(graph, _transposed(graph, b), a)
                else:
                    relu = len(users) == 1 and users[0].target is _aten.relu.default
                    bias = added[0] if added else None
                    product = _insert_linear(graph, a, _transposed(graph, b), bias, relu)
                    users = users if relu else [node]
            for user in users:
                user.replace_all_uses_with(product)
                graph.erase_node(user)
            if node not in users:
                graph.erase_node(node)

    def uuid(self) -> bytes:
        return get_hash_for_files((__file__,))


def _is_eligible(node: Any) -> bool:
    if node.op != "call_function" or node.target not in (_aten.mm.default, _aten.addmm.default):
        return False
    *added, a, b = [argument.meta["val"] for argument in node.args]
    rows, inner, columns = a.shape[0], a.shape[1], b.shape[1]
    return (
        a.device.type == "cpu"
        and a.dtype in _dtypes()
        and all(isinstance(size, int) for size in (rows, inner, columns))
        and columns > 1
        and rows * inner * columns >= _FEWEST
        and all(bias.shape == (columns,) for bias in added)
        and all(node.kwargs.get(name, 1) == 1 for name in ("alpha", "beta"))
    )


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
