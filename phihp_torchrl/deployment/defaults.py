"""Torch's global defaults of dtype and device, which a caller may have changed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch


@contextmanager
def plain_defaults() -> Iterator[None]:
    """Create tensors in float32 on the CPU, whatever the caller's defaults are, and restore them.

    Examples:
        >>> before = torch.get_default_dtype()
        >>> torch.set_default_dtype(torch.float64)
        >>> with plain_defaults():
        ...     inside = torch.zeros(1).dtype
        >>> inside, torch.zeros(1).dtype
        (torch.float32, torch.float64)
        >>> torch.set_default_dtype(before)
    """
    dtype = torch.get_default_dtype()
    with ExitStack() as stack:
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            torch.set_default_dtype(dtype)
