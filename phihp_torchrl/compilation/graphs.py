"""Functions as one full graph each, compiled at their first call or ahead of time."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor, nn
from torch._C._dynamo.eval_frame import reset_code

from phihp_torchrl.compilation.matrix_products import FasterProducts

P = ParamSpec("P")
R = TypeVar("R")


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
            ours["post_grad_custom_post_pass"] = FasterProducts()
        options["options"] = {**ours, **options.get("options", {})}
    defaults: dict[str, Any] = {"fullgraph": True, "dynamic": False}
    return torch.compile(graph, **{**defaults, **options})


def compile_ahead(module: nn.Module, arguments: tuple[Tensor, ...], path: str | Path) -> None:
    """Compile a call of a module, with its weights, into a package of AOTInductor.

    The weights are constants of the package, laid out for its kernels when it is made. The
    compiler's headers are not precompiled for it: that takes long, and pays only on a machine that
    makes many packages.

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
                "freezing": True,
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
