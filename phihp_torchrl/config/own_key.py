"""Signatures by a key of the user's, which tell what this user made on this machine."""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
from pathlib import Path

import platformdirs

STATE_VARIABLE = "PHIHP_STATE_DIR"
"""Environment variable with the folder of the user's key, in the place of the system's own."""


def own_signature(text: str) -> str:
    """Sign a text with the user's key, which is made if there is none.

    Args:
        text: the text.

    Returns:
        The signature, in hexadecimal digits.

    Raises:
        OSError: if there is no key and none can be made.
    """
    return _signature(text, _key(make=True))


def is_own_signature(signature: object, text: str) -> bool:
    """Whether a signature is the user's own, of this text.

    Args:
        signature: what is said to be :func:`own_signature` of the text.
        text: the text.
    """
    if not isinstance(signature, str) or not signature.isascii():
        return False
    try:
        ours = _signature(text, _key(make=False))
    except OSError:
        return False
    return hmac.compare_digest(ours, signature)


def _signature(text: str, key: bytes) -> str:
    return hmac.new(key, text.encode(), hashlib.sha256).hexdigest()


def _key(*, make: bool) -> bytes:
    """The user's key, which never leaves the user's own folder.

    Raises:
        OSError: if there is none and none can be made.
    """
    root = os.environ.get(STATE_VARIABLE) or platformdirs.user_state_path("phihp_torchrl")
    path = Path(root).expanduser() / "key"
    if make and not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        stage = path.with_name(f".key.{secrets.token_hex(8)}")
        handle = os.open(stage, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as file:
            file.write(secrets.token_bytes(32))
        try:
            os.link(stage, path)  # the first of several wins
        except FileExistsError:
            pass
        except OSError:  # a file system without links
            os.replace(stage, path)
        finally:
            stage.unlink(missing_ok=True)
    if len(key := path.read_bytes()) < 32:
        raise OSError(f"{path} is no key; remove it")
    return key
