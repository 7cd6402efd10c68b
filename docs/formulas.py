"""Draw formulas while the pages are built, so that they need neither a script nor a network.

mkdocs runs this as a hook. ``pymdownx.arithmatex`` marks the formulas of a page and of the
docstrings on it; ziamath draws each as SVG, in units of the text around it and in its colour, and
the TeX goes along for screen readers. A formula that cannot be drawn stops the build.
"""

from __future__ import annotations

import html
import re
from functools import cache
from typing import Any

import ziamath
from mkdocs.exceptions import Abort
from ziamath.tex import tex2mml

_SIZE = 17.0
"""Font size that formulas are drawn at, in px; one em of the page."""
_MARKED = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\(?:\(|\[)(?P<tex>.*?)\\(?:\)|\])</(?P=tag)>',
    re.DOTALL,
)
_HEAD = re.compile(r'<svg (?P<names>.*?) ?width="(?P<width>[\d.]+)" height="(?P<height>[\d.]+)"')

ziamath.config.svg2 = False  # paths alone: identifiers would meet on one page


def on_page_content(page_html: str, *, page: Any, **_: Any) -> str:
    """Replace each marked formula by its drawing."""

    def replace(match: re.Match[str]) -> str:
        inline = match["tag"] == "span"
        try:
            drawing = draw(html.unescape(match["tex"]).strip(), inline=inline)
        except Exception as error:  # ziamath's faults are of any kind
            raise Abort(f"{page.file.src_path}: cannot draw {match['tex']!r}: {error}") from error
        return drawing if inline else f'<div class="formula">{drawing}</div>'

    return _MARKED.sub(replace, page_html)


@cache
def draw(tex: str, *, inline: bool) -> str:
    """A formula as SVG, in em.

    Raises:
        ValueError: for a command that is not known.
    """
    if unknown := re.findall(r"\\\w+", tex2mml(tex, inline=inline)):
        raise ValueError(f"unknown commands {unknown}")
    formula = ziamath.Latex(tex, size=_SIZE, color="currentColor", inline=inline)
    head = _HEAD.match(formula.svg())
    if head is None:
        raise ValueError("expected an SVG with a width and a height")
    width, height = float(head["width"]) / _SIZE, float(head["height"]) / _SIZE
    place = f"width:{width:.3f}em;height:{height:.3f}em"
    if inline:
        place += f";vertical-align:{formula.getyofst() / _SIZE:.3f}em"
    label = html.escape(" ".join(tex.split()), quote=True)
    return (
        f'<svg role="img" aria-label="{label}" style="{place}" {head["names"]}'
        f"{formula.svg()[head.end() :]}"
    )
