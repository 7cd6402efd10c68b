"""What a policy that is judged must give, and what a caller may give for a whole number."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from phihp_torchrl.config import ConfigError, is_whole


def acted(tensordict: TensorDictBase, shape: Sequence[int]) -> Tensor:
    """The action that a policy has written.

    Args:
        tensordict: what the policy returned.
        shape: what the action's shape must be.

    Raises:
        ConfigError: if there is none, or one of another shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> acted(TensorDict(action=torch.zeros(3), batch_size=[3]), (3, 1))
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: policy: expected it to write 'action' of shape [3, 1], \
got shape [3].
    """
    action: Any = tensordict.get("action", None)
    if action is None or action.shape != tuple(shape):
        got = "none" if action is None else f"shape {list(action.shape)}"
        raise ConfigError(
            "policy", f"expected it to write 'action' of shape {list(shape)}, got {got}."
        )
    return action


def whole(key: str, value: Any, expected: str, least: int) -> int:
    """A whole number, also one of NumPy's, as one of Python's.

    Raises:
        ConfigError: for anything else, and for less than ``least``.

    Examples:
        >>> import numpy as np
        >>> whole("episodes", np.int64(3), "a positive whole number", 1)
        3
    """
    try:
        number = value if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = value
    if not is_whole(number, least):
        raise ConfigError(key, f"expected {expected}, got {value!r}.")
    return int(number)
