"""Prioritized replay of slices of episodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, pad
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from phihp_torchrl.tdmpc.sampler import TensorPrioritizedSliceSampler


class EpisodeReplay:
    r"""Episodes of any length, replayed as slices of ``horizon`` transitions by their priority.

    Every transition may begin a slice, the last of an episode too: what is missing after the end is
    padding, with ``"valid"`` false. So slices never reach into the next episode, and the losses see
    terminations at every step of the horizon.

    A new transition has the highest priority there has been. The importance weights of a batch,
    :math:`(N p_i)^{-\beta}`, are divided by the greatest of them.

    Args:
        capacity: transitions kept, including padding; new ones replace the oldest.
        horizon: transitions in a slice.
        batch_size: slices in a batch.
        alpha: how much priorities count; 0 samples uniformly.
        beta: how much the weights correct for it.
        generator: source of randomness.

    Examples:
        >>> replay = EpisodeReplay(1000, horizon=5, batch_size=4)
        >>> step = TensorDict(
        ...     observation=torch.zeros(20, 3),
        ...     reward=torch.ones(20, 1),
        ...     terminated=torch.zeros(20, 1, dtype=torch.bool),
        ...     batch_size=[20],
        ... )
        >>> replay.extend(
        ...     TensorDict(
        ...         observation=torch.zeros(20, 3),
        ...         action=torch.zeros(20, 1),
        ...         next=step,
        ...         batch_size=[20],
        ...     )
        ... )
        >>> batch = replay.sample()
        >>> batch.batch_size, batch["next", "reward"].shape
        (torch.Size([4, 5]), torch.Size([4, 5, 1]))
    """

    def __init__(
        self,
        capacity: int,
        horizon: int,
        batch_size: int,
        *,
        alpha: float = 0.6,
        beta: float = 0.4,
        generator: torch.Generator | None = None,
    ) -> None:
        self.horizon = horizon
        self.episodes = 0
        self.sampler = TensorPrioritizedSliceSampler(
            capacity,
            alpha=alpha,
            beta=beta,
            slice_len=horizon,
            traj_key="episode",
            cache_values=True,
            truncated_key=None,
        )
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(capacity),
            sampler=self.sampler,
            batch_size=batch_size * horizon,
            generator=generator,
        )

    def __len__(self) -> int:
        return len(self.buffer)

    def extend(self, episode: TensorDictBase) -> None:
        """Add one whole episode.

        Args:
            episode: ``[T]`` with ``observation``, ``action`` and, under ``"next"``,
                ``observation``, ``reward`` and ``terminated``.
        """
        steps = len(episode)
        rows = TensorDict(
            observation=episode["observation"],
            action=episode["action"],
            valid=torch.ones(steps, dtype=torch.bool),
            next=episode["next"].select("observation", "reward", "terminated"),
            batch_size=[steps],
        )
        rows = pad(rows, [0, self.horizon - 1])
        rows["episode"] = torch.full((len(rows),), self.episodes)
        self.buffer.extend(rows)
        self.episodes += 1

    def sample(self) -> TensorDict:
        """Slices ``[batch_size, horizon]``, with ``"index"`` and ``"priority_weight"``."""
        slices = self.buffer.sample().reshape(-1, self.horizon)
        weight = slices["priority_weight"]
        return slices.set("priority_weight", (weight / weight.max()).to(torch.float32))

    def update_priority(self, slices: TensorDictBase, priority: Tensor) -> None:
        """Give the slices, by where they begin, new priorities ``[batch_size]``."""
        self.sampler.update_priority(slices["index"][:, 0].reshape(-1), priority)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the buffer without the generator, as tensors and numbers."""
        storage = self.buffer.storage
        return {
            "rows": storage[:].to_dict() if len(storage) else {},
            "cursor": self.buffer.writer._cursor,
            "sampler": self.sampler.state_dict(),
            "episodes": self.episodes,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self.buffer.empty()
        if state["rows"]:
            self.buffer.extend(TensorDict(state["rows"]).auto_batch_size_(1))
        self.buffer.writer._cursor = state["cursor"]
        self.sampler.load_state_dict(state["sampler"])
        self.episodes = state["episodes"]
