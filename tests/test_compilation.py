"""Compiled graphs compute what was written, by oneDNN where that pays."""

from __future__ import annotations

import gc
import json
import weakref

import pytest
import torch
from torch._inductor.utils import run_and_get_code
from torch.nn import functional as F

from phihp_torchrl.compilation import compile_graph

LARGE, SMALL = 192, 8  # a product of three LARGE sides goes to oneDNN
CALL = "phihp_torchrl.linear.default("


def check(function, *arguments, calls, tolerance=1e-5):
    """Compiled, the function gives the same, by so many calls of oneDNN."""
    expected = function(*arguments)
    found, code = run_and_get_code(compile_graph(function), *arguments)
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance * 10)
    assert sum(part.count(CALL) for part in code) == calls


@pytest.mark.parametrize(("size", "calls"), [(LARGE, 1), (SMALL, 0)])
def test_products(size, calls):
    a, b = torch.randn(size, size), torch.randn(size, size)
    check(torch.mm, a, b, calls=calls)
    check(lambda a, b: a.t() @ b + 1, a, b, calls=calls)


def test_layers_with_their_relu():
    x, weight, bias = torch.randn(LARGE, LARGE), torch.randn(LARGE, LARGE), torch.randn(LARGE)
    check(lambda *t: F.linear(*t).relu(), x, weight, bias, calls=1)
    check(lambda *t: F.linear(*t), x, weight, bias, calls=1)
    # What the ReLU came from is used as well.
    check(lambda *t: (h := F.linear(*t)) + h.relu(), x, weight, bias, calls=1)
    check(lambda x, w, b: torch.addmm(b, x, w, beta=0.5).relu(), x, weight, bias, calls=0)
    check(lambda x, w, b: torch.addmm(b.unsqueeze(1), x, w), x, weight, bias, calls=0)


def test_gradients():
    x, first, second = (torch.randn(LARGE, LARGE) / 10 for _ in range(3))

    def loss(first, second, x):
        return F.linear(F.linear(x, first).relu(), second).square().mean()

    # Two layers forward, two gradients of weights and one of the hidden layer.
    check(torch.func.grad(loss, (0, 1)), first, second, x, calls=5)


def test_bfloat16():
    x, weight = (torch.randn(LARGE, LARGE, dtype=torch.bfloat16) for _ in range(2))
    calls = int(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    check(lambda x, w: F.linear(x, w).relu(), x, weight, calls=calls, tolerance=2e-2)


def test_float64_stays_with_blas():
    a = torch.randn(LARGE, LARGE, dtype=torch.float64)
    check(torch.mm, a, a, calls=0)


def test_every_function_has_its_own_graphs():
    def scale(x):
        return 2 * x

    with torch._dynamo.config.patch(error_on_recompile=True):
        for size in range(2, 2 + 2 * torch._dynamo.config.recompile_limit):
            compiled = compile_graph(scale, backend="eager")
            assert compiled(torch.ones(size)).tolist() == [2.0] * size


def test_graphs_are_released_with_their_function():
    kept = []

    def backend(graph, _):
        kept.append(weakref.ref(graph))
        return graph.forward

    for _ in range(2):
        layer = torch.nn.Linear(2, 2)
        compiled = compile_graph(layer.forward, backend=backend)
        compiled(torch.ones(1, 2))
        kept += [weakref.ref(layer), weakref.ref(compiled)]
        del layer, compiled
    gc.collect()
    assert [part() for part in kept] == [None] * 6


def test_a_graph_fits_its_arguments_and_the_modes_of_modules():
    dropout = torch.nn.Dropout(1.0)
    compiled = compile_graph(lambda x, sign=1: sign * dropout(x), backend="eager")
    ones = torch.ones(2)
    assert compiled(ones).tolist() == [0.0, 0.0]
    dropout.eval()
    assert compiled(ones).tolist() == [1.0, 1.0]
    assert compiled(ones, sign=-1).tolist() == [-1.0, -1.0]
    assert compiled(ones.double()).dtype == torch.float64


def test_weights_may_change_and_be_replaced():
    layer = torch.nn.Linear(2, 2)
    compiled = compile_graph(layer.forward, backend="eager")
    x = torch.randn(3, 2)
    compiled(x)
    for change in (
        lambda: layer.weight.data.mul_(2),
        lambda: setattr(layer, "weight", torch.nn.Parameter(torch.randn(2, 2))),
    ):
        change()
        assert compiled(x).equal(layer(x))


def test_options_are_added_to_ours():
    x = torch.randn(LARGE, LARGE)
    compiled = compile_graph(torch.mm, options={"epilogue_fusion": False})
    _, code = run_and_get_code(compiled, x, x)
    assert CALL in code[0]


def test_a_graph_that_would_break_fails():
    with pytest.raises(torch._dynamo.exc.Unsupported):
        compile_graph(lambda x: x if x.sum() > 0 else -x, backend="eager")(torch.ones(2))


def test_not_enabled():
    assert compile_graph(abs, enabled=False) is abs


COMPILING = """
import json, multiprocessing, os
os.environ["TORCHINDUCTOR_CACHE_DIR"] = {cache!r}
import torch
from phihp_torchrl.compilation import compile_graph
fork = multiprocessing.get_context("fork")
together = fork.Barrier(2)

def compiling():
    together.wait(60)
    found = compile_graph(lambda x: (x @ x).relu().sum(0))(torch.ones(4, 4))
    os.write(1, (json.dumps(found.tolist()) + chr(10)).encode())

both = [fork.Process(target=compiling) for _ in range(2)]
for process in both:
    process.start()
for process in both:
    process.join()
assert [process.exitcode for process in both] == [0, 0]
"""


@pytest.mark.slow
def test_two_processes_may_compile_with_one_cache_at_the_same_time(tmp_path, forks):
    forks.start(COMPILING.format(cache=str(tmp_path / "cache")))
    lines, code = forks.end()
    assert code == 0
    assert any((tmp_path / "cache").iterdir())
    assert [json.loads(line) for line in lines] == [[16.0] * 4] * 2
