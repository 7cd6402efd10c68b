"""The error that every wrong setting raises, with its key and what was expected."""

from __future__ import annotations


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


ConfigError.__module__ = "phihp_torchrl.config"  # the name that tracebacks show
