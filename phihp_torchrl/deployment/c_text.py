"""Numbers and names as text of a C file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor


def table(name: str, values: Tensor | Iterable[float]) -> str:
    """A constant array of floats, each as it is to the bit.

    Examples:
        >>> print(table("low", [-2.0, 0.1]), end="")
        static const float low[] = {
            -2.0f, 0.100000001f
        };
    """
    flat = torch.as_tensor(values, dtype=torch.float32).detach().cpu().flatten().tolist()
    words = [f"{each:.9g}" for each in flat]
    words = [word if any(c in word for c in ".e") else f"{word}.0" for word in words]
    lines = [", ".join(f"{w}f" for w in words[i : i + 8]) for i in range(0, len(words), 8)]
    return f"static const float {name}[] = {{\n    " + ",\n    ".join(lines) + "\n};\n"


def whole_table(name: str, values: Sequence[int]) -> str:
    r"""A constant array of whole numbers.

    Examples:
        >>> whole_table("lag_at", [4, 5])
        'static const int lag_at[] = {4, 5};\n'
    """
    return f"static const int {name}[] = {{{', '.join(map(str, values))}}};\n"


def in_comment(text: str) -> str:
    """A text from elsewhere, such as a name, as it may stand in a comment: it cannot end it.

    Examples:
        >>> in_comment("rise */ fall")
        'rise * / fall'
    """
    return " ".join(text.replace("*/", "* /").replace("/*", "/ *").split())
