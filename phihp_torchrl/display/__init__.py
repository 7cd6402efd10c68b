"""What is shown of a run: lines while it goes on, and pages of HTML about what came out.

Nothing in this folder imports torch, so that the first line is there before torch is.
"""

from __future__ import annotations

from phihp_torchrl.display.activity import activity
from phihp_torchrl.display.page import cautions, html_page
from phihp_torchrl.display.progress import Progress, loading
from phihp_torchrl.display.svg import Numbers, Series, chart, figure, interval_bar, thin
from phihp_torchrl.display.tables import Cell, facts, number, said, table
from phihp_torchrl.display.words import duration

__all__: list[str] = []  # what is here serves the folders above
