"""Gradients of a loss with respect to layers, in the way that costs least where it is called."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor


def grad_and_value(
    loss: Callable[..., Tensor], layers: Sequence[Tensor], *args: Any
) -> tuple[Sequence[Tensor], Tensor]:
    """Compute the gradients of ``loss(layers, *args)`` with respect to the layers, and its value.

    A compiler takes :func:`torch.func.grad_and_value` as a part of its graph. Eagerly that function
    wraps each tensor at each operation, and about half of the time of an update goes there; the
    tape of :mod:`torch.autograd` finds the same gradients to the last bit.

    Args:
        loss: a function of the layers and of ``args``, whose result has no dimension.
        layers: the tensors to differentiate by; they are not changed, and need not require
            gradients.
        args: further arguments, which are constants.

    Returns:
        One gradient for each layer, zero where the loss does not depend on it, and the loss. Both
        are detached.

    Examples:
        >>> slopes, value = grad_and_value(lambda w: (3.0 * w[0]).sum(), [torch.ones(2)])
        >>> slopes[0], value
        (tensor([3., 3.]), tensor(6.))
    """
    if torch.compiler.is_compiling():
        return torch.func.grad_and_value(loss)(layers, *args)
    with torch.enable_grad():
        leaves = [layer.detach().requires_grad_() for layer in layers]
        value = loss(leaves, *args)
        slopes = torch.autograd.grad(value, leaves, allow_unused=True, materialize_grads=True)
    return slopes, value.detach()
