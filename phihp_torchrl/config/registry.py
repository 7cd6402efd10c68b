"""Registries by name, for tasks, worlds, planners, phases and methods."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeVar

from phihp_torchrl.config.errors import ConfigError, meant

T = TypeVar("T")


class Registry(Mapping[str, T]):
    """Entries by name, in the order in which they were registered.

    Args:
        what: key of the setting that chooses an entry; errors name it.

    Examples:
        >>> hues = Registry("hue")
        >>> hues.register("r", 1)
        1
        >>> hues.find("s")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: hue: expected one of ['r'], got 's'.
    """

    def __init__(self, what: str) -> None:
        self.what = what
        self._entries: dict[str, T] = {}

    def register(self, name: str, entry: T, *, replace: bool = False) -> T:
        """Register ``entry`` under ``name``, and return it.

        Raises:
            ConfigError: if the name is taken and ``replace`` is false.
        """
        if name in self._entries and not replace:
            raise ConfigError(
                self.what, f"{name!r} is registered already; pass replace=True to replace it."
            )
        self._entries[name] = entry
        return entry

    def find(self, name: str) -> T:
        """Return the entry of that name.

        Raises:
            ConfigError: if there is none; the message lists the registered names.
        """
        if name not in self:
            hint = meant(name, self)
            raise ConfigError(self.what, f"expected one of {sorted(self)}, got {name!r}{hint}")
        return self._entries[name]

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self._entries  # a list is no name either

    def __getitem__(self, name: str) -> T:
        return self._entries[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)
