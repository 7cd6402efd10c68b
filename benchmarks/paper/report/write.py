"""A report on disk: one page, a CSV file for each table, an SVG and a PNG for each figure."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from matplotlib import rc_context

from report.sections import Picture, Section


def section_markdown(section: Section, level: int = 2, *, title: bool = True) -> str:
    """A section as Markdown, its figures by their relative path.

    Args:
        section: the section.
        level: of its heading; those of tables are one lower.
        title: whether to write its heading.
    """
    parts = [f"{'#' * level} {section.title}\n"] if title else []
    if section.text:
        parts.append(f"{section.text}\n")
    for heading, table in section.tables.items():
        parts += [f"{'#' * (level + 1)} {heading}\n", table.markdown()]
    parts += [f"![{p.caption}](figures/{p.name}.svg)\n" for p in section.pictures]
    return "\n".join(parts)


def write_report(
    directory: Path, title: str, introduction: str, sections: Sequence[Section]
) -> None:
    """Write ``README.md``, ``tables/*.csv`` and ``figures/*.svg`` and ``*.png``.

    The same sections make the same files, byte by byte.
    """
    for folder in ("tables", "figures"):
        (directory / folder).mkdir(parents=True, exist_ok=True)
    for section in sections:
        for table in section.tables.values():
            (directory / "tables" / f"{table.name}.csv").write_text(table.csv())
        for picture in section.pictures:
            _draw(picture, directory / "figures")
    pages = [f"# {title}\n", f"{introduction}\n", *map(section_markdown, sections)]
    (directory / "README.md").write_text("\n".join(pages))


def put_between(page: Path, start: str, end: str, text: str) -> bool:
    """Put a text between two markers of a page; whether it has them."""
    old = page.read_text() if page.is_file() else ""
    if start not in old or end not in old.split(start)[1]:
        return False
    before, rest = old.split(start, 1)
    page.write_text(f"{before}{start}\n{text}\n{end}{rest.split(end, 1)[1]}")
    return True


def _draw(picture: Picture, directory: Path) -> None:
    path = directory / f"{picture.name}.svg"
    # Random names of elements and the date would make each file a new one.
    with rc_context({"svg.hashsalt": picture.name}):
        picture.figure.savefig(path, metadata={"Date": None})
    # matplotlib leaves spaces at the ends of lines.
    path.write_text(re.sub(r" +$", "", path.read_text(), flags=re.MULTILINE))
    picture.figure.set_layout_engine(None)  # it stands; to lay it out takes most of the time
    picture.figure.savefig(path.with_suffix(".png"), dpi=100)
