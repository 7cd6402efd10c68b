"""What a report is made of: sections of text, tables and figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from matplotlib.figure import Figure

from report.tables import Table


@dataclass(frozen=True)
class Picture:
    """A figure.

    Args:
        name: of its files.
        figure: the figure.
        caption: what it shows.
    """

    name: str
    figure: Figure
    caption: str


@dataclass(frozen=True)
class Section:
    """A part of the report.

    Args:
        title: its heading.
        text: paragraphs of Markdown, above tables and figures.
        tables: its tables, by the line above each.
        pictures: its figures.
    """

    title: str
    text: str = ""
    tables: Mapping[str, Table] = field(default_factory=dict)
    pictures: Iterable[Picture] = ()
