"""TorchRL's prioritized slices with priorities that are plain tensors."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl._utils import logger
from torchrl.data.replay_buffers import PrioritizedSliceSampler


class TensorPrioritizedSliceSampler(PrioritizedSliceSampler):
    """:class:`torchrl.data.replay_buffers.PrioritizedSliceSampler` without compiled segment trees.

    TorchRL's binaries do not load beside every build of torch, and its trees can be saved by pickle
    alone. These sum a whole tensor at each sample instead, which is little beside the update that
    follows. Arguments are those of the class it extends.

    References: prioritized replay, https://arxiv.org/abs/1511.05952.

    Examples:
        >>> sampler = TensorPrioritizedSliceSampler(
        ...     100, alpha=0.6, beta=0.4, slice_len=5, traj_key="episode"
        ... )
        >>> sorted(sampler.state_dict())
        ['max_priority', 'priorities']
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        level = logger.level
        logger.setLevel(logging.ERROR)  # it would warn of the binaries that are not needed here
        try:
            super().__init__(*args, **kwargs)
        finally:
            logger.setLevel(level)

    def _init(self) -> None:
        values = torch.zeros(self._max_capacity, dtype=torch.float64)
        self._sum_tree, self._min_tree = _Sums(values), _Minima(values)
        self._set_max_priority(None)

    def _set_max_priority(self, highest: Tensor | None) -> None:
        known: Any = None if highest is None else (highest, None)
        self._max_priority = known

    def _empty(self) -> None:
        self._init()

    def state_dict(self) -> dict[str, Any]:
        """The priorities ``[max_capacity]``, to the power of alpha, and the highest ever."""
        known: Any = self._max_priority  # the highest and where it was, or twice None
        return {
            "priorities": self._sum_tree.values.clone(),
            "max_priority": None if known[0] is None else float(known[0]),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self._sum_tree.values.copy_(state_dict["priorities"])
        highest = state_dict["max_priority"]
        self._set_max_priority(None if highest is None else torch.tensor(highest))
        self._cache.clear()


class _Sums:
    """One tensor with the interface of the sampler's tree of sums."""

    def __init__(self, values: Tensor) -> None:
        self.values = values
        self._stop = len(values)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, np.ndarray):
            return self.values[torch.from_numpy(index)].numpy()
        return self.values[index]

    def __setitem__(self, index: Any, value: Any) -> None:
        self.values[torch.as_tensor(index)] = torch.as_tensor(value, dtype=self.values.dtype)

    def query(self, start: int, stop: int) -> Tensor:
        """The sum of a range, which those that are then drawn come from."""
        self._stop = stop
        return self.values[start:stop].sum()

    def scan_lower_bound(self, mass: Tensor) -> Tensor:
        """The first index at which the running sum exceeds ``mass``."""
        mass = torch.as_tensor(mass, dtype=self.values.dtype)
        return torch.searchsorted(self.values[: self._stop].cumsum(0), mass, right=True)


class _Minima:
    """The same tensor with the interface of the sampler's tree of minima."""

    def __init__(self, values: Tensor) -> None:
        self.values = values

    def __setitem__(self, index: Any, value: Any) -> None:
        """The sums hold the values already."""

    def query(self, start: int, stop: int) -> Tensor:
        """The smallest positive value of a range."""
        values = self.values[start:stop]
        return torch.where(values > 0, values, torch.inf).amin()
