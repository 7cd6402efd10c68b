"""A replay buffer in one flat tensor."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from phihp_torchrl.config import check_count
from phihp_torchrl.imagination import Batch


class FlatReplay(nn.Module):
    """A replay buffer with uniform sampling, which keeps each transition as a row of one tensor.

    Sampling is a single gather, whereas a dictionary of storages needs one for each entry. The
    buffer is part of the module's state, so checkpoints contain it.

    Args:
        capacity: number of transitions kept; new ones replace the oldest.
        state_dim: state components, ``n``.
        action_dim: action components, ``m``.

    Examples:
        >>> replay = FlatReplay(100, state_dim=2, action_dim=1)
        >>> rows = torch.zeros(10, 2), torch.zeros(10, 1), torch.ones(10), torch.zeros(10, 2)
        >>> replay.extend(Batch(*rows, torch.zeros(10, dtype=torch.bool)))
        >>> len(replay), replay.sample(4).reward.tolist()
        (10, [1.0, 1.0, 1.0, 1.0])
    """

    rows: Tensor
    cursor: Tensor

    def __init__(self, capacity: int, state_dim: int, action_dim: int) -> None:
        super().__init__()
        self.capacity = capacity
        check_count(self, "capacity")
        self.sizes = (state_dim, action_dim, 1, state_dim, 1)
        self.register_buffer("rows", torch.zeros(capacity, sum(self.sizes)))
        self.register_buffer("cursor", torch.zeros((), dtype=torch.int64))
        self._written = 0

    @property
    def written(self) -> int:
        """Number of transitions that were ever added."""
        return self._written

    def __len__(self) -> int:
        return min(self._written, self.rows.shape[0])

    def extend(self, batch: Batch) -> None:
        """Add transitions, replacing the oldest if the buffer is full."""
        capacity, count = self.rows.shape[0], len(batch.reward)
        rows = torch.cat(
            [
                batch.state,
                batch.action,
                batch.reward.unsqueeze(-1),
                batch.next_state,
                batch.terminated.unsqueeze(-1).to(self.rows.dtype),
            ],
            -1,
        )[-capacity:]
        start = (self._written + count - len(rows)) % capacity
        first = min(len(rows), capacity - start)
        self.rows[start : start + first] = rows[:first]
        self.rows[: len(rows) - first] = rows[first:]
        self._written += count
        self.cursor.fill_(self._written)

    def sample(self, batch_size: int, generator: torch.Generator | None = None) -> Batch:
        """Draw ``batch_size`` transitions uniformly, with replacement.

        Raises:
            RuntimeError: if the buffer is empty.
        """
        if len(self) == 0:
            raise RuntimeError("sample: the replay buffer is empty; extend it first.")
        index = torch.randint(
            len(self), (batch_size,), generator=generator, device=self.rows.device
        )
        state, action, reward, next_state, terminated = self.rows[index].split(self.sizes, -1)
        return Batch(state, action, reward[:, 0], next_state, terminated[:, 0] > 0.5)

    def _load_from_state_dict(self, *args, **kwargs) -> None:  # type: ignore[no-untyped-def]
        super()._load_from_state_dict(*args, **kwargs)
        self._written = int(self.cursor)
