"""What the presets set, for recipes and documentation that compare them; no recipe itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

CONFIG = Path(__file__).parent / "config"


def settings(preset: str) -> dict[str, dict[str, Any]]:
    """Value of every key of a preset, by key and task; the preset's own value is under ``""``."""
    base = _flatten(yaml.safe_load((CONFIG / "preset" / f"{preset}.yaml").read_text()))
    values = {key: {"": value} for key, value in base.items()}
    for path in sorted((CONFIG / "task").glob("*.yaml"), key=lambda path: path.stem):
        sections = yaml.safe_load(path.read_text())["presets"]
        for key, value in {**base, **_flatten(sections.get(preset) or {})}.items():
            values[key][path.stem] = value
    return values


def _flatten(mapping: dict[str, Any], path: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in mapping.items():
        name = f"{path}{key}"
        flat |= _flatten(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return flat
