"""Import of modules that settings name."""

from __future__ import annotations

import importlib
import os
import sys
from types import ModuleType


def import_named(module: str) -> ModuleType:
    """Import a module by its dotted name; modules in the working directory are found too.

    Raises:
        Exception: whatever the import raises, for a module may raise anything.

    Examples:
        >>> import_named("json.decoder").__name__
        'json.decoder'
    """
    if (here := os.getcwd()) not in sys.path:
        sys.path.insert(0, here)
    return importlib.import_module(module)
