"""Products of compiled graphs are the same by either library, and the faster one is asked."""

from __future__ import annotations

import time

import pytest
import torch
from torch._inductor.utils import run_and_get_code
from torch.nn import functional as F

from phihp_torchrl.compilation import compile_graph, matrix_products
from phihp_torchrl.compilation.matrix_products import (
    Product,
    by_blas,
    by_onednn,
    onednn_is_faster,
)

LARGE, SMALL = 192, 8  # a product of three LARGE sides may go to oneDNN
CALL = "phihp_torchrl.linear.default("


@pytest.fixture(autouse=True)
def chosen(monkeypatch):
    """The machine's choice, true for oneDNN; no graph of another choice comes from the cache."""
    choice = {"onednn": True}
    monkeypatch.setattr(matrix_products, "onednn_is_faster", lambda *_: choice["onednn"])
    patches = (
        torch._inductor.config.patch(fx_graph_cache=False),
        torch._functorch.config.patch(enable_autograd_cache=False),
    )
    with patches[0], patches[1]:
        yield choice


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


def test_options_are_added_to_ours():
    x = torch.randn(LARGE, LARGE)
    compiled = compile_graph(torch.mm, options={"epilogue_fusion": False})
    _, code = run_and_get_code(compiled, x, x)
    assert CALL in code[0]


def test_the_blas_keeps_what_it_does_faster(chosen):
    chosen["onednn"] = False
    x, weight, bias = torch.randn(LARGE, LARGE), torch.randn(LARGE, LARGE), torch.randn(LARGE)
    check(lambda *t: F.linear(*t).relu(), x, weight, bias, calls=0)


SQUARE = (LARGE, LARGE), (LARGE, 1)
ONE = Product(SQUARE, SQUARE, torch.float32)


@pytest.mark.parametrize(("slower", "faster"), [("by_blas", True), ("by_onednn", False)])
def test_a_choice_is_measured_once(monkeypatch, slower, faster):
    measured = []

    def multiply(a, b, bias, product):
        measured.append(product)
        return a

    def slow(*arguments):
        time.sleep(0.01)
        return multiply(*arguments)

    for name in ("by_blas", "by_onednn"):
        monkeypatch.setattr(matrix_products, name, slow if name == slower else multiply)
    onednn_is_faster.cache_clear()
    assert onednn_is_faster(ONE, 1) is faster
    count = len(measured)
    assert onednn_is_faster(ONE, 1) is faster
    assert len(measured) == count > 0
    onednn_is_faster.cache_clear()


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("layout", [(LARGE, 1), (1, LARGE)])
def test_both_libraries_give_the_same(layout, turned):
    a, b = (torch.randn(LARGE, LARGE).as_strided((LARGE, LARGE), layout) for _ in range(2))
    product = ONE._replace(turned=turned)
    expected, found = by_blas(a, b, None, product), by_onednn(a, b, None, product)
    torch.testing.assert_close(found, expected.t() if turned else expected, atol=1e-4, rtol=1e-4)
    if not turned:
        added, product = torch.randn(LARGE), product._replace(bias=True, relu=True)
        both = by_blas(a, b, added, product), by_onednn(a, b, added, product)
        torch.testing.assert_close(*both, atol=1e-4, rtol=1e-4)
        assert both[0].min() == 0.0


def test_a_gradient_of_a_weight_is_measured_as_it_runs(monkeypatch):
    asked = []
    monkeypatch.setattr(
        matrix_products, "onednn_is_faster", lambda product, _: asked.append(product) or True
    )
    x, weight = torch.randn(LARGE, LARGE) / 10, torch.randn(LARGE, LARGE) / 10

    def loss(weight, x):
        return F.linear(x, weight).square().mean()

    compile_graph(torch.func.grad(loss))(weight, x)
    forward, gradient = asked
    assert (forward.left[1], forward.right[1]) == ((LARGE, 1), (1, LARGE))
    assert (1, LARGE) in (gradient.left[1], gradient.right[1])


def test_a_graph_has_what_was_measured(monkeypatch):
    monkeypatch.setattr(matrix_products, "onednn_is_faster", onednn_is_faster)  # no fixed choice
    onednn_is_faster.cache_clear()
    x = torch.randn(LARGE, LARGE)
    _, code = run_and_get_code(compile_graph(torch.mm), x, x)  # measures while it compiles
    assert onednn_is_faster.cache_info().misses == 1
    chosen = onednn_is_faster(ONE, torch.get_num_threads())
    assert onednn_is_faster.cache_info().misses == 1
    assert (CALL in code[0]) is chosen
