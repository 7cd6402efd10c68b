"""Digests of files, and JSON files that have their own."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

DIGEST = "sha256"
"""The key under which a JSON file has the digest of the rest of it."""


def digest_of(data: bytes | str) -> str:
    """The SHA-256 of bytes, or of a text in UTF-8, in hexadecimal digits.

    Examples:
        >>> digest_of("")[:8]
        'e3b0c442'
    """
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()


def digest_of_values(values: Any) -> str:
    """The digest of plain values, whatever the order of their keys.

    Examples:
        >>> digest_of_values({"a": 1, "b": 2}) == digest_of_values({"b": 2, "a": 1})
        True
    """
    return digest_of(json.dumps(values, sort_keys=True, separators=(",", ":"), default=str))


def sealed(content: Mapping[str, Any]) -> str:
    """The text of a JSON file that has its own digest.

    Examples:
        >>> unsealed(sealed({"seed": 3}))
        {'seed': 3}
    """
    # As JSON reads it, where keys are texts and tuples lists.
    plain = json.loads(json.dumps({k: v for k, v in content.items() if k != DIGEST}))
    return json.dumps({**plain, DIGEST: digest_of_values(plain)}, indent=2) + "\n"


def unsealed(text: str) -> dict[str, Any]:
    """The content of such a file; files of earlier versions have no digest, and are not checked.

    Raises:
        ValueError: for a text that is no JSON object, or that was changed.
    """
    content = json.loads(text)
    if not isinstance(content, dict):
        raise ValueError(f"expected a JSON object, got {type(content).__name__}")
    check_seal(content)
    content.pop(DIGEST, None)
    return content


def check_seal(content: Mapping[str, Any]) -> None:
    """Compare the content of a JSON file with the digest in it, if there is one.

    Raises:
        ValueError: if they differ.
    """
    rest = {key: value for key, value in content.items() if key != DIGEST}
    if DIGEST in content and content[DIGEST] != digest_of_values(rest):
        raise ValueError("its digest is another: it was damaged or edited")
