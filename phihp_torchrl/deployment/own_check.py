"""A check that a user wrote, which may fail, in a loop that must not stop."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

_log = logging.getLogger(__name__)


class OwnCheck:
    """A user's check that never raises: where it fails, its answer is no.

    The first failure is logged with its traceback. Later ones are not, for a loop has many steps.

    Args:
        name: what it is, for the log.
        check: the check.

    Examples:
        >>> check = OwnCheck("accept", lambda action: action < limit)  # there is no `limit`
        >>> check(0.5)
        False
    """

    def __init__(self, name: str, check: Callable[..., Any]) -> None:
        self._name, self._check, self._has_failed = name, check, False

    def __call__(self, *values: Any) -> bool:
        try:
            return bool(self._check(*values))
        except Exception:
            if not self._has_failed:
                self._has_failed = True
                _log.exception(
                    "%s failed, which counts as a no, and so do later failures, which are not "
                    "logged.",
                    self._name,
                )
            return False
