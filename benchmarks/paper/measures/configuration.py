"""A fingerprint of a run's settings, by which two runs are seen to be of one configuration."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from typing import Any

# What may differ between runs of one configuration: place, seed, and what is shown. Only these
# settings themselves are free: one of the same name in another section is a setting like any other.
_FREE = ("seed", "run_dir", "resume", "logger", "progress", "plugins")
_FREE_IN = {"evaluate": ("video",)}


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
        >>> worlds = ({"world": {"seed": 1}}, {"world": {"seed": 9}})
        >>> len({configuration_hash(world) for world in worlds})
        2
    """
    kept = _without(settings, _FREE)
    for section, free in _FREE_IN.items():
        if isinstance(kept.get(section), Mapping):
            kept[section] = _without(kept[section], free)
    text = json.dumps(_plain(kept), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _without(settings: Mapping[str, Any], free: Collection[str]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if key not in free}


def _plain(value: Any) -> Any:
    """The value as JSON has it, whatever kinds of mapping and sequence it is made of."""
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    return [_plain(part) for part in value] if isinstance(value, (list, tuple)) else value
