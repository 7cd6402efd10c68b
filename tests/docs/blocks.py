"""The fenced blocks of README.md and of the pages in docs/, and what marks them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = {
    str(path.relative_to(ROOT)): path
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
}
"""Pages by their path in the repository."""

SHELLS = ("sh", "bash", "shell", "console")
_FENCE = re.compile(r'^(?P<indent> *)```(?P<language>\w*)(?: +title="(?P<title>[^"]+)")? *$')
_INLINE = re.compile(
    r"`((?:phihp (?:train|evaluate|identify|export) \w|phihp list|python (?:-m )?\w[\w./]+)"
    r"[^`\n]*)`"
)
_OPEN = re.compile(r"\.\.\.|=NAME")  # what a reader has to fill in
_MARK = re.compile(r"^ *<!-- example: (?P<mark>slow|not run: .+?) -->$")


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Args:
        page: the page that it is on.
        line: number of its first line there, from 1.
        language: what follows the fence.
        title: the file that it prints, or ``None``.
        text: its lines, without their common indentation.
        mark: ``""``, ``"slow"`` or ``"not run: <reason>"``.
    """

    page: str
    line: int
    language: str
    title: str | None
    text: str
    mark: str = ""

    @property
    def place(self) -> str:
        """Where it is, for messages."""
        return f"{self.page}:{self.line}"

    @property
    def runs(self) -> bool:
        """Whether it is run, rather than only compiled."""
        return not self.mark.startswith("not run")


def read_blocks(page: str) -> list[Block]:
    """All blocks of a page, in order.

    A comment right above a block marks it: ``<!-- example: slow -->`` for one that takes long, and
    ``<!-- example: not run: reason -->`` for one that cannot be run here.
    """
    blocks, mark, start = [], "", None
    lines = PAGES[page].read_text().splitlines()
    for number, line in enumerate(lines, 1):
        fence = _FENCE.match(line)
        if start is None:
            if fence:
                start, opening = number, fence
            elif found := _MARK.match(line):
                mark = found["mark"]
            elif line.strip():
                mark = ""
        elif line == f"{opening['indent']}```":
            indent = len(opening["indent"])
            text = "\n".join(inner[indent:] for inner in lines[start : number - 1]) + "\n"
            block = Block(page, start + 1, opening["language"], opening["title"], text, mark)
            blocks.append(block)
            start, mark = None, ""
    assert start is None, f"{page}:{start}: this fence is never closed"
    return blocks


BLOCKS = {page: read_blocks(page) for page in PAGES}
"""The blocks of each page."""


def write_titled(place: Path) -> None:
    """Write every file that some page prints under its title into ``place``."""
    for block in (block for blocks in BLOCKS.values() for block in blocks):
        if block.title is not None:
            path = place / block.title
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text)


def commands(page: str) -> list[tuple[str, str]]:
    """The commands that a page prints, each with its place: in shell blocks and in running text."""
    found = []
    for block in BLOCKS[page]:
        if block.language in SHELLS:
            joined = block.text.replace("\\\n", " ")
            found += [(block.place, line.strip()) for line in joined.splitlines()]
    text = PAGES[page].read_text()
    found += [(page, code) for code in _INLINE.findall(text) if not _OPEN.search(code)]
    return [(place, line) for place, line in found if line and not line.startswith("#")]
