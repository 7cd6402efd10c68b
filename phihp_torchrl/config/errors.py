"""The error that every wrong setting raises, with its key, what was expected and what was meant."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class ConfigError(ValueError):
    """A setting that is unknown, missing, of a wrong type or out of range.

    Args:
        key: dotted name of the setting, or the name of the argument.
        reason: what was expected and what was found, as a sentence.

    Examples:
        >>> error = ConfigError("gamma", "expected a number in (0, 1], got 2.")
        >>> str(error.inside("policy.td3"))
        'policy.td3.gamma: expected a number in (0, 1], got 2.'
    """

    def __init__(self, key: str, reason: str) -> None:
        super().__init__(key, reason)
        self.key = key
        self.reason = reason

    def __str__(self) -> str:
        return f"{self.key}: {self.reason}"

    def inside(self, path: str) -> ConfigError:
        """Return the same error with the section ``path`` before its key."""
        return ConfigError(f"{path}.{self.key}" if path else self.key, self.reason)


def meant(name: object, names: Iterable[str]) -> str:
    """How a message about an unknown name ends: with the name that may have been meant, if any.

    Examples:
        >>> meant("pendulun", ["acrobot", "pendulum"])
        "; did you mean 'pendulum'?"
        >>> meant("zzz", ["acrobot", "pendulum"])
        '.'
    """
    close = get_close_matches(str(name), list(names), n=1)
    return f"; did you mean {close[0]!r}?" if close else "."


ConfigError.__module__ = "phihp_torchrl.config"  # the name that tracebacks show
