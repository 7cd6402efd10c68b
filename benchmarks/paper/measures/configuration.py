"""A fingerprint of a run's settings, by which two runs are seen to be of one configuration."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

# What may differ between runs of one configuration: place, seed, and what is shown.
_FREE = ("seed", "run_dir", "resume", "logger", "progress", "video", "plugins")


def configuration_hash(settings: Mapping[str, Any]) -> str:
    """Sixteen hex digits of the SHA-256 of settings, but for place, seed and what is shown.

    Args:
        settings: those of a run, as its ``config.yaml`` has them.

    Examples:
        >>> one = {"seed": 0, "policy": {"updates": 8}, "evaluate": {"video": True}}
        >>> other = {"seed": 1, "policy": {"updates": 8}, "evaluate": {"video": False}}
        >>> configuration_hash(one) == configuration_hash(other)
        True
        >>> configuration_hash(one) == configuration_hash({**one, "policy": {"updates": 9}})
        False
    """
    text = json.dumps(_kept(settings), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _kept(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _kept(part) for key, part in value.items() if key not in _FREE}
    return [_kept(part) for part in value] if isinstance(value, (list, tuple)) else value
