"""Typed configuration: dataclasses out of plain mappings, each fault named by its dotted key."""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from difflib import get_close_matches
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

T = TypeVar("T")


class ConfigError(ValueError):
    """A key that is unknown or missing, or has a wrong value; the message names it."""


def from_mapping(cls: type[T], mapping: Mapping[str, Any], path: str = "") -> T:
    """Build the dataclass ``cls`` from ``mapping``, strictly.

    A field may be called otherwise in the mapping by ``field(metadata={"key": ...})``, as ``from``
    must. A ``ValueError`` out of ``__post_init__`` is taken to begin with the field's name.

    Args:
        cls: a dataclass; its fields may be numbers, strings, booleans, tuples, mappings, literals,
            optional ones of these, and dataclasses.
        mapping: values by key, as YAML gives them.
        path: dotted name of the mapping itself, for messages.

    Raises:
        ConfigError: for a key that is unknown or missing, and for a value of the wrong type or out
            of range, by its dotted name.

    Examples:
        >>> from phihp_torchrl.agents.td3 import TD3Config
        >>> from_mapping(TD3Config, {"gamma": 0.9}, "policy.td3").gamma
        0.9
        >>> from_mapping(TD3Config, {"gama": 0.9}, "td3")
        Traceback (most recent call last):
        ...
        phihp_torchrl.trainers.config.ConfigError: td3.gama: unknown key; did you mean 'gamma'?
    """
    if not isinstance(mapping, Mapping):
        raise ConfigError(f"{path or cls.__name__}: expected keys and values, got {mapping!r}.")
    known = {_key(f): f for f in fields(cls) if f.init}  # type: ignore[arg-type]
    for key in mapping:
        if key not in known:
            close = get_close_matches(str(key), known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"expected one of {sorted(known)}."
            raise ConfigError(f"{_join(path, key)}: unknown key; {hint}")
    hints = typing.get_type_hints(cls)
    values = {}
    for key, f in known.items():
        if key in mapping:
            values[f.name] = _convert(hints[f.name], mapping[key], _join(path, key))
        elif f.default is MISSING and f.default_factory is MISSING:
            raise ConfigError(f"{_join(path, key)}: missing, and it has no default.")
    try:
        return cls(**values)
    except ConfigError:
        raise
    except ValueError as error:
        name = str(error).split(":", 1)[0].split(",", 1)[0].strip()
        raise ConfigError(f"{path}{'.' if name in known else ': '}{error}".lstrip(".: ")) from error


def to_mapping(config: Any) -> dict[str, Any]:
    """The inverse of :func:`from_mapping`: plain dictionaries, lists and scalars."""
    return {_key(f): _plain(getattr(config, f.name)) for f in fields(config) if f.init}


def differences(ours: Any, theirs: Any, path: str = "") -> list[str]:
    """Dotted names of the keys in which two plain mappings differ, each with both values."""
    if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
        keys = [*ours, *(key for key in theirs if key not in ours)]
        pairs = ((key, ours.get(key), theirs.get(key)) for key in keys)
        return [line for key, a, b in pairs for line in differences(a, b, _join(path, key))]
    return [] if ours == theirs else [f"{path}: {ours!r}, not {theirs!r}"]


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
    """``value`` as the type ``hint``, or a ConfigError that names ``path``."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _convert_union(args, value, path)
    if origin is Literal:
        if value not in args:
            raise ConfigError(f"{path}: expected one of {list(args)}, got {value!r}.")
        return value
    if origin is tuple:
        items = _expect(isinstance(value, (list, tuple)), "a list", value, path)
        if args[-1] is not Ellipsis and len(items) != len(args):
            raise ConfigError(f"{path}: expected {len(args)} values, got {value!r}.")
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
        raise ConfigError(f"{path}: expected {expected}, got {value!r}.")
    return value
