"""PhIHP's twin without a prior, whose cells a grid of PhIHP made before it was a method."""

from __future__ import annotations

LABEL = "data-driven"
"""Label of those cells, made with ``'overrides=["model.kind=data_driven"]'``."""


def read_as(method: str, label: str) -> tuple[str, str]:
    """The method and the label under which a report has the cells of these.

    Examples:
        >>> read_as("phihp", "data-driven"), read_as("phihp", "paper")
        (('dd-phihp', 'default'), ('phihp', 'paper'))
    """
    return ("dd-phihp", "default") if (method, label) == ("phihp", LABEL) else (method, label)
