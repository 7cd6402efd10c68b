"""Compiled graphs compute what was written, and are released with their functions."""

from __future__ import annotations

import gc
import json
import weakref

import pytest
import torch

from phihp_torchrl.compilation import compile_graph


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
torch._inductor.config.cpp_cache_precompile_headers = False
torch._inductor.config.cpp.vec_isa_ok = True
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
