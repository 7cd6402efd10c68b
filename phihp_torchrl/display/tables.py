"""Numbers, tables and lists of facts as HTML."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, NamedTuple


class Cell(NamedTuple):
    """A cell of a table: HTML, its class, and whether it is the row's header."""

    html: str
    css: str = ""
    head: bool = False


def number(value: float | None, digits: int = 4) -> str:
    """A number for readers; a dash for none.

    Examples:
        >>> number(0.123456), number(None), number(12345.6), number(1234567.0)
        ('0.1235', '–', '12346', '1.235e+06')
    """
    if value is None or value != value:
        return "–"
    return f"{value:.0f}" if 10.0**digits <= abs(value) < 1e6 else f"{value:.{digits}g}"


def table(head: Sequence[str], rows: Iterable[Sequence[Cell]], caption: str, css: str = "") -> str:
    """A table with header cells, which a narrow screen can scroll, or stack with class ``stack``.

    Args:
        head: texts of the header.
        rows: cells of each row.
        caption: what it shows, for those who do not see it.
        css: its class.
    """
    body, numeric = [], [False] * len(head)
    for row in rows:
        cells = []
        for i, (label, cell) in enumerate(zip(head, row, strict=True)):
            numeric[i] |= "number" in cell.css
            css_of = f' class="{cell.css}{"" if cell.html else " empty"}"'
            if cell.head:
                cells.append(f'<th scope="row" role="rowheader"{css_of}>{cell.html}</th>')
            else:
                label = escape(label)
                content = f"<span>{cell.html}</span>"
                cells.append(f'<td role="cell" data-label="{label}"{css_of}>{content}</td>')
        kept = ' class="kept"' if any("kept" in cell.css for cell in row) else ""
        body.append(f'<tr role="row"{kept}>{"".join(cells)}</tr>')
    heads = "".join(
        f'<th scope="col" role="columnheader"{" class=number" if n else ""}>{escape(h)}</th>'
        for h, n in zip(head, numeric, strict=True)
    )
    label = escape(caption)
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{label}">'
        f'<table role="table" class="{css}" aria-label="{label}">'
        f'<thead role="rowgroup"><tr role="row">{heads}</tr></thead>\n'
        f'<tbody role="rowgroup">{chr(10).join(body)}</tbody></table></div>\n'
    )


def facts(of: Mapping[str, Any]) -> str:
    r"""Names with values, which are numbers, texts, and lists or mappings of them.

    Args:
        of: the values by name; ``_`` in a name is a space, and ``_s`` at its end means seconds.

    Examples:
        >>> facts({"fit_s": 1.5})
        '<dl class="facts"><dt>fit (s)</dt><dd>1.5</dd></dl>\n'
    """
    rows = "".join(
        f"<dt>{escape(_name(key))}</dt><dd>{escape(_fact(value))}</dd>" for key, value in of.items()
    )
    return f'<dl class="facts">{rows}</dl>\n'


def _name(key: str) -> str:
    return key.replace("_", " ").removesuffix(" s") + (" (s)" if key.endswith("_s") else "")


def _fact(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {_fact(v)}" for k, v in value.items()) or "none"
    if isinstance(value, (list, tuple)):
        return " to ".join(_fact(v) for v in value) if len(value) == 2 else ", ".join(
            _fact(v) for v in value)  # fmt: skip
    return number(value, 5) if isinstance(value, float) else str(value)


def said(about: str, html: str) -> str:
    """A section with a sentence before it; nothing where it has no content."""
    return f"<p>{about}</p>\n{html}" if html else ""
