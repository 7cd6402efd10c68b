"""A page of HTML that needs no network, no script and no other file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape

from phihp_torchrl.display.style import STYLE

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""What the page may load: pictures that are in it, and nothing else; a browser holds it to that."""


def html_page(
    title: str, tiles: Sequence[tuple[str, str]], sections: Mapping[str, tuple[str, str]]
) -> str:
    """A page with its style and its pictures in itself.

    It fits wide and narrow screens and paper, and follows a reader's light or dark.

    Args:
        title: its heading, plain text.
        tiles: the page in a few numbers: each a short text, and what it is.
        sections: heading and HTML of each section by its anchor; those without content are left
            out.

    Examples:
        >>> text = html_page("my <rig>", [("3", "runs")], {"a": ("A", "<p>x</p>"), "b": ("B", "")})
        >>> text[:15], "my &lt;rig&gt;" in text, 'id="a"' in text, 'id="b"' in text
        ('<!doctype html>', True, True, False)
    """
    kept = {key: (head, html) for key, (head, html) in sections.items() if html}
    links = "".join(f'<li><a href="#{key}">{head}</a></li>' for key, (head, _) in kept.items())
    body = "".join(
        f'<section id="{key}" aria-labelledby="{key}-head">\n<h2 id="{key}-head">{head}</h2>\n'
        f"{html}</section>\n"
        for key, (head, html) in kept.items()
    )
    items = "".join(f"<li><b>{escape(big)}</b>{escape(small)}</li>" for big, small in tiles)
    name = escape(title)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        f"<title>{name}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<header>\n"
        f'<h1>{name}</h1>\n<ul class="tiles">{items}</ul>\n'
        f'<nav aria-label="Sections"><ul>{links}</ul></nav>\n</header>\n'
        f"<main>\n{body}</main>\n</body>\n</html>\n"
    )


def cautions(found: Iterable[tuple[str, str]]) -> str:
    """What must be known before the numbers are trusted, each with what to do about it.

    Args:
        found: text and advice of each; those of one advice stand together, and an empty one means
            that the text has it.

    Examples:
        >>> print(cautions([("The clock jitters.", "Use its stamps.")]), end="")
        <div class="warning"><p><strong>▲ The clock jitters.</strong></p><p>What to do: Use its \
stamps.</p></div>
    """
    texts: dict[str, list[str]] = {}
    for text, advice in found:
        texts.setdefault(advice, []).append(text)
    return "".join(
        '<div class="warning">'
        + "".join(f"<p><strong>▲ {escape(text)}</strong></p>" for text in of)
        + (f"<p>What to do: {escape(advice)}</p></div>\n" if advice else "</div>\n")
        for advice, of in texts.items()
    )
