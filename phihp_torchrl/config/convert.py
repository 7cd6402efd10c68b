"""Conversion of plain values to the types that a dataclass of settings declares."""

from __future__ import annotations

import math
import types
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from phihp_torchrl.config.checks import LARGEST_FLOAT32
from phihp_torchrl.config.errors import ConfigError

Read = Callable[[type[Any], Any, str], Any]
"""How a dataclass is read from a mapping, for a dotted name."""

_HINTS: dict[Any, dict[str, Any]] = {}

INFINITE = {"infinite": True}
"""Metadata of a field whose numbers may be infinite, as limits that do not limit."""


def check_fields(config: Any) -> None:
    """Refuse fields of a frozen dataclass whose values are not what their annotations say.

    Every dataclass of settings calls this first in ``__post_init__``, so that the same values pass
    in Python as in YAML: numbers are finite and within the range of float32, unless the field has
    the metadata :data:`INFINITE`. NumPy's scalars, arrays and tensors of one number without
    dimensions become plain numbers, and lists become tuples.

    Raises:
        ConfigError: for the first field that is not of its type, by its name.

    Examples:
        >>> from phihp_torchrl.agents import TD3Config
        >>> TD3Config(tau="fast")
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: tau: expected a number, got 'fast'.
    """
    hints = hints_of(type(config))
    for f in fields(config):
        if f.init:
            value, infinite = getattr(config, f.name), "infinite" in f.metadata
            kept = convert(hints[f.name], value, f.name, infinite=infinite)
            if kept is not value:
                object.__setattr__(config, f.name, kept)


def plain_fields(config: Any) -> None:
    """Make plain numbers and tuples of the arrays and tensors in a frozen dataclass.

    Examples:
        >>> import numpy as np
        >>> from phihp_torchrl import Constant
        >>> Constant(np.float32(0.5), high=np.array(2.0))
        Constant(guess=0.5, low=0.0, high=2.0, fixed=False)
    """
    for f in fields(config):
        if f.init and (kept := plain(getattr(config, f.name))) is not getattr(config, f.name):
            object.__setattr__(config, f.name, kept)


def plain(value: Any) -> Any:
    """Make plain numbers, lists of an array and tuples of what NumPy or torch hold.

    Examples:
        >>> import numpy as np
        >>> plain((np.float32(0.5), np.int64(3))), plain(np.ones(2))
        ((0.5, 3), (1.0, 1.0))
    """
    if hasattr(value, "tolist") and hasattr(value, "shape"):
        value = value.tolist()
        return tuple(value) if isinstance(value, list) else value
    if type(value) in (tuple, list):
        kept = tuple(map(plain, value))
        return value if all(a is b for a, b in zip(kept, value, strict=True)) else kept
    return value


def hints_of(cls: Any) -> dict[str, Any]:
    """The types of a dataclass's fields; those of steps and discounts keep what they are called."""
    if cls not in _HINTS:
        _HINTS[cls] = get_type_hints(cls, include_extras=True)
    return _HINTS[cls]


def convert(
    hint: Any, value: Any, path: str, read: Read | None = None, *, infinite: bool = False
) -> Any:
    """Convert ``value`` to the type ``hint``.

    Args:
        hint: a number's type, a text's, a tuple's, a mapping's, a literal, a union or a dataclass.
        value: the value.
        path: dotted name of the value, for error messages.
        read: how mappings are read where a dataclass is expected; by default they are refused.
        infinite: whether numbers may be infinite.

    Raises:
        ConfigError: for a value of another type; the message has the dotted name.

    Examples:
        >>> convert(tuple[float, ...], [1, 2.5], "sizes")
        (1.0, 2.5)
    """
    origin, args = get_origin(hint), get_args(hint)
    value = plain(value)
    if origin is Annotated:  # of a text of seconds or a number, which has checks of its own
        return value
    if origin in (Union, types.UnionType):
        return _convert_union(args, value, path, read, infinite)
    if origin is Literal:
        known = type(value) in map(type, args) and value in args
        return _expect(known, f"one of {list(args)}", value, path)
    if origin is tuple:
        return _convert_tuple(args, value, path, read, infinite)
    if origin is not None and issubclass(origin, Mapping):
        items = _expect(isinstance(value, Mapping), "keys and values", value, path)
        return {
            key: convert(args[1], item, join(path, key), read, infinite=infinite)
            for key, item in items.items()
        }
    if origin is Callable:
        return _expect(callable(value), "a function", value, path)
    if is_dataclass(hint):
        if read is not None and not isinstance(value, hint):  # type: ignore[arg-type]
            return read(hint, value, path)  # type: ignore[arg-type]
        return _expect(isinstance(value, hint), hint.__name__, value, path)  # type: ignore
    if hint is float:
        return _convert_float(value, path, infinite)
    if hint is int:
        whole = isinstance(value, int) and not isinstance(value, bool)
        return _expect(whole, "a whole number", value, path)
    if hint in (bool, str):
        name = {bool: "true or false", str: "a text"}[hint]
        return _expect(isinstance(value, hint), name, value, path)
    return value


def join(path: str, key: object) -> str:
    """A dotted name from that of a section and a key in it."""
    return f"{path}.{key}" if path else str(key)


def _convert_float(value: Any, path: str, infinite: bool) -> float:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    _expect(number, "a number", value, path)
    bounded = abs(value) <= LARGEST_FLOAT32 or (infinite and value in (-math.inf, math.inf))
    return float(_expect(bounded, "a finite number", value, path))


def _convert_tuple(
    args: tuple[Any, ...], value: Any, path: str, read: Read | None, infinite: bool
) -> tuple[Any, ...]:
    items = _expect(isinstance(value, (list, tuple)), "a list", value, path)
    if args[-1] is not Ellipsis and len(items) != len(args):
        raise ConfigError(path, f"expected {len(args)} values, got {value!r}.")
    of = args[:1] * len(items) if args[-1] is Ellipsis else args
    pairs = enumerate(zip(of, items, strict=True))
    kept = tuple(
        convert(hint, item, f"{path}[{i}]", read, infinite=infinite) for i, (hint, item) in pairs
    )
    same = isinstance(value, tuple) and all(a is b for a, b in zip(kept, value, strict=True))
    return value if same else kept


def _convert_union(
    hints: tuple[Any, ...], value: Any, path: str, read: Read | None, infinite: bool
) -> Any:
    if value is None and type(None) in hints:
        return None
    errors = []
    for hint in hints:
        if hint is type(None):
            continue
        try:
            return convert(hint, value, path, read, infinite=infinite)
        except ConfigError as error:
            errors.append(error)
    raise errors[0]


def _expect(good: bool, expected: str, value: Any, path: str) -> Any:
    if not good:
        raise ConfigError(path, f"expected {expected}, got {value!r}.")
    return value
