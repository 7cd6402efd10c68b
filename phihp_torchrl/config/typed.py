"""Read dataclasses of settings from plain mappings, and write them; errors name dotted keys."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from difflib import get_close_matches
from typing import Any, TypeVar

from phihp_torchrl.config.convert import convert, hints_of, join
from phihp_torchrl.config.errors import ConfigError, meant
from phihp_torchrl.config.registry import Registry

T = TypeVar("T")

MISSING_VALUE = "???"
"""The value by which YAML marks a key that must be given."""

KIND = "kind"
"""The key that says which of several kinds a section of settings is for."""


def from_mapping(cls: type[T], mapping: Mapping[str, Any], path: str = "") -> T:
    """Build the dataclass ``cls`` from ``mapping``, strictly.

    ``field(metadata={"key": ...})`` gives a field another name in the mapping, which a Python
    keyword such as ``from`` needs. A field with ``metadata={"kinds": registry}`` is a section whose
    key ``kind`` chooses one of the registry's dataclasses.

    Args:
        cls: a dataclass; its fields may be numbers, strings, booleans, tuples, mappings, literals,
            optional ones of these, and dataclasses.
        mapping: values by key, as YAML gives them.
        path: dotted name of the mapping, for error messages.

    Raises:
        ConfigError: for a key that is unknown or missing, and for a value of the wrong type or out
            of range; the message has the dotted name.

    Examples:
        >>> from phihp_torchrl.agents import TD3Config
        >>> from_mapping(TD3Config, {"gamma": 0.9}, "policy.td3").gamma
        0.9
        >>> from_mapping(TD3Config, {"gama": 0.9}, "td3")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: td3.gama: unknown key; did you mean 'gamma'?
    """
    if not isinstance(mapping, Mapping):
        raise ConfigError(path or cls.__name__, f"expected keys and values, got {mapping!r}.")
    known = {_key(f): f for f in fields(cls) if f.init}  # type: ignore[arg-type]
    for key in mapping:
        if key not in known:
            close = get_close_matches(str(key), known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"expected one of {sorted(known)}."
            raise ConfigError(join(path, key), f"unknown key; {hint}")
    hints = hints_of(cls)
    values = {}
    for key, f in known.items():
        if mapping.get(key, MISSING_VALUE) != MISSING_VALUE:
            where = join(path, key)
            kinds = f.metadata.get("kinds")
            if kinds is not None and mapping[key] is not None:
                values[f.name] = read_kind(kinds, mapping[key], where)
            else:
                values[f.name] = convert(hints[f.name], mapping[key], where, from_mapping)
        elif f.default is MISSING and f.default_factory is MISSING:
            raise ConfigError(join(path, key), f"missing: expected {key}=...; it has no default.")
    try:
        return cls(**values)
    except ConfigError as error:
        raise error.inside(path) from error


def read_kind(kinds: Registry[Any], mapping: Mapping[str, Any], path: str) -> Any:
    """Read a section whose key ``kind`` chooses one of ``kinds``, by default the first.

    Args:
        kinds: registered kinds; the attribute ``config`` of each is the dataclass of its settings.
        mapping: the section.
        path: dotted name of the section.

    Raises:
        ConfigError: as :func:`from_mapping`, and for an unknown kind.
    """
    if not isinstance(mapping, Mapping):
        raise ConfigError(path, f"expected keys and values, got {mapping!r}.")
    rest = dict(mapping)
    name = rest.pop(KIND, None) or next(iter(kinds))
    if name not in kinds:
        reason = f"expected one of {sorted(kinds)}, got {name!r}{meant(name, kinds)}"
        raise ConfigError(join(path, KIND), reason)
    return from_mapping(kinds[name].config, rest, path)


def to_mapping(config: Any) -> dict[str, Any]:
    """Write a dataclass as plain dictionaries, lists and scalars; inverts :func:`from_mapping`.

    Examples:
        >>> from phihp_torchrl.imagination import StartConfig
        >>> to_mapping(StartConfig())["coverage"]
        0.6
    """
    return {
        _key(f): kind_mapping(value)
        if "kinds" in f.metadata and (value := getattr(config, f.name)) is not None
        else _plain(getattr(config, f.name))
        for f in fields(config)
        if f.init
    }


def kind_mapping(config: Any) -> dict[str, Any]:
    """Write settings together with their ``kind``; inverts :func:`read_kind`."""
    return {KIND: config.kind, **to_mapping(config)}


def differences(ours: Any, theirs: Any, path: str = "") -> list[tuple[str, Any, Any]]:
    """List where two plain mappings differ, as (dotted key, our value, their value).

    Examples:
        >>> differences({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}})
        [('a.c', 2, 3)]
    """
    if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
        keys = [*ours, *(key for key in theirs if key not in ours)]
        pairs = ((key, ours.get(key), theirs.get(key)) for key in keys)
        return [found for key, a, b in pairs for found in differences(a, b, join(path, key))]
    return [] if ours == theirs else [(path, ours, theirs)]


def default_of(f: Field) -> Any:
    """Return the default of a field of a dataclass, or ``"???"`` if it must be given.

    Examples:
        >>> from phihp_torchrl.worlds import TorchRLConfig
        >>> {f.name: default_of(f) for f in fields(TorchRLConfig)}
        {'make': '???', 'options': {}, 'copies': False}
    """
    if f.default is not MISSING:
        return f.default
    return MISSING_VALUE if f.default_factory is MISSING else f.default_factory()


def flatten(mapping: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Return the values of nested mappings by dotted key.

    Examples:
        >>> flatten({"td3": {"gamma": 0.99}, "seed": 0})
        {'td3.gamma': 0.99, 'seed': 0}
    """
    flat: dict[str, Any] = {}
    for key, value in mapping.items():
        name = join(path, key)
        flat |= flatten(value, name) if isinstance(value, Mapping) and value else {name: value}
    return flat


def _key(f: Field) -> str:
    return f.metadata.get("key", f.name)


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return to_mapping(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value
