"""Show the docstrings' reStructuredText, which TorchRL uses, in Markdown pages."""

from __future__ import annotations

import re
import textwrap
from typing import Any

from griffe import Extension

_ROLE = re.compile(r":(?:class|func|meth|attr|data|mod):`~?(?:[\w.]*\.)?(\w+)`")
_MATH = re.compile(
    r"^(?P<indent> *)\.\. math::(?P<first>.*)\n(?P<rest>(?:\n|(?P=indent) +.*\n?)*)", re.MULTILINE
)


class Docstrings(Extension):
    """Turn roles into code and ``.. math::`` blocks into formulas."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """Rewrite one docstring."""
        if obj.docstring is not None:
            text = obj.docstring.value.replace("``", "`")
            if obj.is_class and any(str(base) == "NamedTuple" for base in obj.bases):
                text = text.replace("Args:\n", "Attributes:\n")  # it has no signature of its own
            obj.docstring.value = _MATH.sub(_formula, _ROLE.sub(r"`\1`", text))


def _formula(match: re.Match[str]) -> str:
    body = f"{match['first'].strip()}\n{textwrap.dedent(match['rest'])}".strip()
    if r"\\" in body or "&" in body:
        body = f"\\begin{{aligned}}\n{body}\n\\end{{aligned}}"
    return textwrap.indent(f"$$\n{body}\n$$\n\n", match["indent"])
