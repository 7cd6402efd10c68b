"""Import of users' files and modules that register tasks, worlds, planners, phases and methods."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from phihp_torchrl.config import ConfigError, import_named


def import_plugins(plugins: Sequence[str]) -> None:
    """Import Python files (``path/to/my_task.py``) or modules (``my_package.tasks``), each once.

    Modules in the working directory are found.

    Raises:
        ConfigError: for a plugin that is absent or whose import fails; the message names it.
    """
    if not isinstance(plugins, Sequence) or isinstance(plugins, str):
        raise ConfigError("plugins", f"expected a list of files or modules, got {plugins!r}.")
    for name in plugins:
        if not isinstance(name, str):
            raise ConfigError("plugins", f"expected files or modules, got {name!r}.")
        try:
            if name.endswith(".py"):
                _import_file(Path(name))
            else:
                import_named(name)
        # A user's file may raise anything; the message should name it and the reason.
        except Exception as error:
            raise ConfigError(
                "plugins", f"{name} cannot be imported: {type(error).__name__}: {error}"
            ) from error


def _import_file(path: Path) -> None:
    path = path.resolve()
    module_name = f"phihp_torchrl_plugin_{path.stem}"
    if getattr(sys.modules.get(module_name), "__file__", None) == str(path):
        return
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise ImportError("not a Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules[module_name] = module
