"""Read dataclasses of settings from plain mappings, and write them; errors name dotted keys."""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from difflib import get_close_matches
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from phihp_torchrl.config.errors import ConfigError
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
            raise ConfigError(_join(path, key), f"unknown key; {hint}")
    hints = typing.get_type_hints(cls)
    values = {}
    for key, f in known.items():
        if mapping.get(key, MISSING_VALUE) != MISSING_VALUE:
            where = _join(path, key)
            kinds = f.metadata.get("kinds")
            if kinds is not None and mapping[key] is not None:
                values[f.name] = read_kind(kinds, mapping[key], where)
            else:
                values[f.name] = _convert(hints[f.name], mapping[key], where)
        elif f.default is MISSING and f.default_factory is MISSING:
            raise ConfigError(_join(path, key), f"missing: expected {key}=...; it has no default.")
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
        raise ConfigError(_join(path, KIND), f"expected one of {sorted(kinds)}, got {name!r}.")
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
        return [found for key, a, b in pairs for found in differences(a, b, _join(path, key))]
    return [] if ours == theirs else [(path, ours, theirs)]


def default_of(f: Field) -> Any:
    """Return the default of a field of a dataclass, or ``"???"`` if it must be given.

    Examples:
        >>> from phihp_torchrl.worlds import TorchRLConfig
        >>> {f.name: default_of(f) for f in fields(TorchRLConfig)}
        {'make': '???', 'options': {}}
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
        name = _join(path, key)
        flat |= flatten(value, name) if isinstance(value, Mapping) and value else {name: value}
    return flat


def _key(f: Field) -> str:
    return f.metadata.get("key", f.name)


def _join(path: str, key: object) -> str:
    return f"{path}.{key}" if path else str(key)


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return to_mapping(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def _convert(hint: Any, value: Any, path: str) -> Any:
    """Convert ``value`` to the type ``hint``, or raise a ConfigError that names ``path``."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _convert_union(args, value, path)
    if origin is Literal:
        return _expect(value in args, f"one of {list(args)}", value, path)
    if origin is tuple:
        items = _expect(isinstance(value, (list, tuple)), "a list", value, path)
        if args[-1] is not Ellipsis and len(items) != len(args):
            raise ConfigError(path, f"expected {len(args)} values, got {value!r}.")
        of = args[:1] * len(items) if args[-1] is Ellipsis else args
        pairs = enumerate(zip(of, items, strict=True))
        return tuple(_convert(item_hint, item, f"{path}[{i}]") for i, (item_hint, item) in pairs)
    if origin is not None and issubclass(origin, Mapping):
        items = _expect(isinstance(value, Mapping), "keys and values", value, path)
        return {key: _convert(args[1], item, _join(path, key)) for key, item in items.items()}
    if is_dataclass(hint):
        return from_mapping(hint, value, path)  # type: ignore[arg-type]
    if hint is float:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return float(_expect(number, "a number", value, path))
    if hint is int:
        whole = isinstance(value, int) and not isinstance(value, bool)
        return _expect(whole, "a whole number", value, path)
    if hint in (bool, str):
        name = {bool: "true or false", str: "a text"}[hint]
        return _expect(isinstance(value, hint), name, value, path)
    return value


def _convert_union(hints: tuple[Any, ...], value: Any, path: str) -> Any:
    if value is None and type(None) in hints:
        return None
    errors = []
    for hint in hints:
        if hint is type(None):
            continue
        try:
            return _convert(hint, value, path)
        except ConfigError as error:
            errors.append(error)
    raise errors[0]


def _expect(good: bool, expected: str, value: Any, path: str) -> Any:
    if not good:
        raise ConfigError(path, f"expected {expected}, got {value!r}.")
    return value
