"""A replay buffer that is one flat tensor."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from phihp_torchrl.agents.functional import Batch


class FlatReplay(nn.Module):
    """Uniform replay of transitions, one row of one tensor each.

    Sampling is a single gather, where a dictionary of storages needs one per entry. The whole
    buffer is module state, so checkpoints carry it.

    Args:
        capacity: number of transitions kept; the oldest make room.
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
        if capacity < 1:
            raise ValueError(
                f"capacity: expected a positive number of transitions, got {capacity}."
            )
        self.sizes = (state_dim, action_dim, 1, state_dim, 1)
        self.register_buffer("rows", torch.zeros(capacity, sum(self.sizes)))
        self.register_buffer("cursor", torch.zeros((), dtype=torch.int64))
        self._written = 0

    @property
    def written(self) -> int:
        """Transitions ever added."""
        return self._written

    def __len__(self) -> int:
        return min(self._written, self.rows.shape[0])

    def extend(self, batch: Batch) -> None:
        """Add transitions."""
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
        """Draw ``batch_size`` transitions uniformly, with replacement."""
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
