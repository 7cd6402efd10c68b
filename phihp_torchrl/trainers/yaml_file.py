"""The YAML of runs, read by libyaml: many times faster than by the Python of :mod:`yaml` alone."""

from __future__ import annotations

import re
from typing import Any

import yaml

_TIMES = "tag:yaml.org,2002:timestamp"
_FLOAT = "tag:yaml.org,2002:float"
_FAST: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # not every wheel has libyaml


class _Loader(_FAST):
    """Reads what OmegaConf reads: plain values, no key twice, ``1e-3`` a number and dates texts."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Any:
        found: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in found:
                    problem, mark = f"found duplicate key {key.value}", key.start_mark
                    raise yaml.constructor.ConstructorError(None, None, problem, mark)
                found.add(key.value)
        return super().construct_mapping(node, deep=deep)


_Loader.yaml_implicit_resolvers = {
    first: [each for each in resolvers if each[0] != _TIMES]
    for first, resolvers in _FAST.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver(
    _FLOAT, re.compile(r"[-+]?\d+(?:_\d+)*(?:\.[\d_]*)?[eE][-+]?\d+$"), list("-+0123456789")
)


def parse_yaml(text: str) -> Any:
    r"""Read a text of plain values.

    Args:
        text: the content of a file.

    Returns:
        What it says: mappings, lists, texts, numbers, booleans and ``None``.

    Raises:
        yaml.YAMLError: if it is no YAML, has a key twice, or asks for objects of Python.

    Examples:
        >>> parse_yaml("task: pendulum\ntolerance: 1e-3\nday: 2026-01-31\n")
        {'task': 'pendulum', 'tolerance': 0.001, 'day': '2026-01-31'}
    """
    return yaml.load(text, Loader=_Loader)  # it makes plain values alone
