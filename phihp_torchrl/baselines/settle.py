"""The regulator that takes over from plans where a reference stands still."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from phihp_torchrl.baselines.equilibria import Equilibria
from phihp_torchrl.baselines.lqi import LQI
from phihp_torchrl.baselines.point import LinearModel
from phihp_torchrl.baselines.reference import followed, present
from phihp_torchrl.baselines.riccati import Regulator
from phihp_torchrl.baselines.take_over import TakeOver, check_moved
from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task

_REACH = 0.1
"""Error within which the regulator takes over, in half-ranges of the reference."""
_MOST_ROWS = 1000
"""Values of a component of a reference at which a file may say that the model rests."""
_PATIENCE = 5.0
"""How many times as long as the regulator takes plans are waited for."""
_LEAVE = 3.0
"""How many times as far it goes on, so that who acts does not change with every step."""


class Settle(TakeOver):
    """A regulator with integral action that takes over where a reference stands still.

    It acts where what is known of the reference is constant, since the step before and in the
    preview, and its components are near it: within a tenth of its half-range, or a share of that,
    and three times as far once it acts. Where the reference has stood still for five times as long
    as the regulator takes, and plans have not come that near, it acts within the whole tenth. So
    plans turn and look ahead, and the integral leaves no steady error, also under a load that
    nobody measures. It begins with the integral by which its action is the one that was sent last
    (bumpless transfer; :class:`~phihp_torchrl.baselines.LQI` is the regulator).

    Its numbers are buffers, so it is saved with an agent's weights. It has a memory:
    :meth:`reset` is for the start of an episode, and :meth:`follow` tells it what was sent.

    Args:
        task: a task with a reference of components of its state.
        moved: the registers of the task that belong to the regulator's state, by their places.
        rows: for each component of the reference, the number of values at which the model rests.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import HybridDynamics, Signal, get_task
        >>> def follow(state, action, next_state, reference):
        ...     return -(next_state[..., 0] - reference[..., 0]).square()
        >>> angle = Signal(("theta",), low=(-0.3,), high=(0.3,))
        >>> task = replace(get_task("pendulum"), reference=angle, reward=follow)
        >>> settle = Settle.from_model(task, HybridDynamics.pure_prior(task))
        >>> state = torch.tensor([[0.21, 0.0], [-0.3, 0.0]])
        >>> state = task.with_signals(task.at_rest(state), torch.tensor([[0.2], [0.2]]))
        >>> settle.take(state)[0]
        tensor([ True, False])
    """

    kind: ClassVar[str] = "settle"
    distance: ClassVar[str] = "reach"

    at: Tensor
    keeping: Tensor
    gain: Tensor
    cost: Tensor
    reach: Tensor
    tenth: Tensor
    wait: Tensor

    def __init__(self, task: Task, moved: Sequence[int] = (), rows: Sequence[int] = ()) -> None:
        places = list(followed(task).values())
        actions, physical = task.action_dim, task.system.state_dim
        size, count = physical + len(moved), len(places)
        shapes = {
            "at": [size],
            "keeping": [actions],
            "gain": [actions, size + count],
            "cost": [size + count, size + count],
            "reach": [count],
            "tenth": [count],
            "wait": [],
            **{f"values_{i}": [n] for i, n in enumerate(rows)},
            **{f"shifts_{i}": [n, physical + actions] for i, n in enumerate(rows)},
        }
        super().__init__(task, moved, shapes)
        self.rows, self.places = tuple(rows), places
        self._before: Tensor | None = None
        self._stood: Tensor | None = None
        self._near: Tensor | None = None
        self._sent: Tensor | None = None
        self._built: list[LQI] = []  # in a list, so that its buffers are not this module's

    @classmethod
    def from_model(cls, task: Task, dynamics: nn.Module, share: float = 1.0) -> Settle:
        """Build it in a model.

        Args:
            task: the task.
            dynamics: the model, ``(state, action) -> next state``.
            share: share of a tenth of the reference's half-range in which it takes over.

        Raises:
            ConfigError: where an :class:`~phihp_torchrl.baselines.LQI` can not follow the
                reference.
        """
        lqi = LQI.from_model(task, dynamics)
        point, table = lqi.point, lqi.equilibria
        made = cls(task, point.moved, [len(values) for values in table.values])
        assert task.reference is not None
        half = (torch.tensor(task.reference.high) - torch.tensor(task.reference.low)) / 2
        numbers = {
            "at": point.state,
            "keeping": point.action,
            "gain": torch.as_tensor(lqi.regulator.gain),
            "cost": torch.as_tensor(lqi.regulator.cost),
            "reach": share * _REACH * half,
            "tenth": _REACH * half,
            "wait": torch.tensor(_PATIENCE * max(lqi.times) / task.time_step),
            **{f"values_{i}": values for i, values in enumerate(table.values)},
            **{f"shifts_{i}": shifts for i, shifts in enumerate(table.shifts)},
        }
        made.load_state_dict({name: value.float() for name, value in numbers.items()})
        return made

    def take(self, state: Tensor, starts: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Where it acts, and its action, as the base says; a step of its memory."""
        task, batch = self.task, state.shape[:-1]
        physical, registers = task.split(state)
        known = task.outside.split(registers)["reference"]
        wanted = present(task, registers)
        fresh = torch.zeros(batch, dtype=torch.bool, device=state.device)
        if self._before is None or self._before.shape != wanted.shape:
            self.reset()
            fresh = ~fresh
        elif starts is not None:
            fresh = starts
        before = wanted if self._before is None else self._before.to(wanted)
        was_near = torch.zeros_like(fresh) if self._near is None else self._near & ~fresh
        ahead = known.unflatten(-1, (-1, len(self.places))) == wanted.unsqueeze(-2)
        still = ahead.flatten(-2).all(-1) & ((before == wanted).all(-1) | fresh)
        stood = torch.zeros(batch, device=state.device) if self._stood is None else self._stood
        stood = torch.where(still & ~fresh, stood + 1.0, 0.0)
        error = (physical[..., self.places] - wanted).abs()
        close, tenth = ((error / far.to(state)).amax(-1) for far in (self.reach, self.tenth))
        near = (close <= torch.where(was_near, _LEAVE, 1.0)) | (was_near & (tenth <= 1.0))
        near = still & (near | ((tenth <= 1.0) & (stood > self.wait.to(stood))))
        lqi, new = self._regulator, near & ~was_near
        if self._sent is not None and self._sent.shape[:-1] == batch:
            lqi.go_on_from(state, self._sent.to(state), new & ~fresh)
        action = task.clip_action(lqi.act(state, new if self._sent is None else new & fresh))
        self._before, self._stood, self._near = wanted, stood, near
        return near, action

    def follow(self, sent: Tensor) -> None:
        """Remember the action ``[*batch, m]`` that was sent."""
        self._sent = sent

    def reset(self) -> None:
        """Forget the episode."""
        self._before = self._stood = self._near = self._sent = None
        self._built = []

    @property
    def _regulator(self) -> LQI:
        """The regulator of these buffers, which keeps the integrals."""
        if not self._built:
            numbers = {name: value.double() for name, value in self.named_buffers()}
            size = len(self.at)
            a, b = np.zeros((size, size)), np.zeros((size, self.task.action_dim))
            point = LinearModel(self.task, numbers["at"], numbers["keeping"], a, b, self.moved)
            tables = (
                tuple(numbers[f"{name}_{i}"] for i in range(len(self.rows)))
                for name in ("values", "shifts")
            )
            regulator = Regulator(numbers["gain"].cpu().numpy(), numbers["cost"].cpu().numpy())
            self._built.append(LQI(point, Equilibria(point, *tables), regulator, ()))
        return self._built[0]

    @property
    def config(self) -> dict[str, Any]:
        """Those of the base, and the sizes of its tables."""
        return {**super().config, "rows": list(self.rows)}

    @classmethod
    def from_config(cls, task: Task, config: Mapping[str, Any]) -> Settle:
        """Build what :attr:`config` describes, with buffers of zeros.

        Raises:
            ConfigError: for what the task does not have; the message names the key.
        """
        rows, count = config["rows"], len(followed(task))
        if not isinstance(rows, (list, tuple)) or len(rows) != count or not count:
            raise ConfigError("rows", f"expected {count} numbers, at least one, got {rows!r}.")
        if not all(isinstance(n, int) and 2 <= n <= _MOST_ROWS for n in rows):
            raise ConfigError("rows", f"expected 2 to {_MOST_ROWS} in each, got {rows!r}.")
        return cls(task, check_moved(task, config["moved"]), rows)
