"""Keys of YAML files that no comment explains."""

from __future__ import annotations

import re
from pathlib import Path


def bare_keys(path: Path) -> list[str]:
    """Lines of a YAML file whose key has no comment above it."""
    lines = path.read_text().splitlines()
    bare = []
    for above, line in zip(["", *lines], lines, strict=False):
        key = re.match(r"\s*(- )?(override )?[\w/]+:", line)
        parent = re.match(r"\s*[\w/]+:$", line)  # a heading: its keys have the comments
        if key and not parent and not above.strip().startswith("#"):
            bare.append(line)
    return bare
