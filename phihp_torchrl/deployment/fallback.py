"""Who acts where an agent's action cannot be used: the actor, the last action, rest, or a user."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import torch
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment.safety import Checks
from phihp_torchrl.tasks import Task

_log = logging.getLogger(__name__)

UserControl = Callable[[NDArray[Any]], ArrayLike | None]
"""A controller of the user's: what was measured ``[o]`` to an action ``[m]``, or ``None``."""

Fallback = str | UserControl
"""``"actor"``, ``"hold"``, ``"zero"`` or a controller of the user's."""

_NAMES = ("actor", "hold", "zero")


class FallbackChain:
    """Asks one controller after the other until one has an action that may be sent.

    Args:
        agent: the agent that is replaced.
        task: its task.
        checks: the limits, which also hold for those who take over.
        chosen: who takes over; ``None`` for the actor, if the agent plans and has one, and then
            the last action.

    Raises:
        ConfigError: for a name that is unknown, and for the actor of an agent without.

    Examples:
        >>> from phihp_torchrl import Agent, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> from phihp_torchrl.deployment.safety import Safety
        >>> task = get_task("pendulum")
        >>> checks = Checks(task, Safety(hold_steps=1))
        >>> chain = FallbackChain(Agent(task, actor=Actor(task)), task, checks, None)
        >>> measured, last = torch.tensor([torch.nan, 0.0, 0.0]), torch.ones(1)
        >>> [chain.act(measured, None, last) for _ in range(2)]
        [(tensor([1.]), 'hold'), (tensor([0.]), 'zero')]
    """

    def __init__(
        self,
        agent: TensorDictModuleBase,
        task: Task,
        checks: Checks,
        chosen: Fallback | Sequence[Fallback] | None,
    ) -> None:
        self._task, self._checks = task, checks
        plans = getattr(agent, "planner", None) is not None
        has_actor = plans and getattr(agent, "actor", None) is not None
        if chosen is None:
            chosen = ("actor", "hold") if has_actor else ("hold",)
        order = [chosen] if isinstance(chosen, str) or callable(chosen) else list(chosen)
        for each in order:
            if not callable(each) and each not in _NAMES:
                raise ConfigError(
                    "fallback", f"expected some of {list(_NAMES)} or functions, got {each!r}."
                )
        self._actor = None
        if "actor" in order:
            if not has_actor:
                raise ConfigError(
                    "fallback", "expected an agent that plans and has an actor, for 'actor'."
                )
            self._actor = agent.actor_alone()
        self._order = order
        self.reset()

    def reset(self) -> None:
        """Count held actions from zero, once the agent acts again."""
        self._held = 0

    def warm_up(self, data: TensorDict) -> None:
        """Call the actor once."""
        if self._actor is not None:
            self._actor(data.clone())

    def act(self, measured: Tensor, data: TensorDict | None, last: Tensor) -> tuple[Tensor, str]:
        """Return an action ``[m]`` and the name of who chose it.

        An action that violates a constraint is passed over if rest would not.

        Args:
            measured: what was measured, ``[o]``, which may be wrong.
            data: what the agent read, or ``None`` where the measurement is not to be trusted.
            last: the action before, ``[m]``.
        """
        checks, rest = self._checks, self._checks.towards_rest(last)
        seen = measured if data is None else data["observation"].cpu()
        spares = data is not None and not checks.violates(seen, rest)
        for each in self._order:
            name = each if isinstance(each, str) else getattr(each, "__name__", "user")
            try:
                action = self._ask(each, measured, data, last)
            except Exception:
                _log.exception("The fallback %s failed; the next one acts.", name)
                continue
            if action is None or checks.action(action, last) is not None:
                continue
            command = checks.command(action, last)
            if not (spares and checks.violates(seen, command)):
                return command, name
        return rest, "zero"

    def _ask(
        self, each: Fallback, measured: Tensor, data: TensorDict | None, last: Tensor
    ) -> Tensor | None:
        if callable(each):
            given = each(measured.numpy().copy())
            return None if given is None else self._as_action(given)
        if each == "actor":
            assert self._actor is not None
            return None if data is None else self._actor(data.clone())["action"].cpu()
        if each == "hold":
            self._held += 1
            return last if self._held <= self._checks.safety.hold_steps else None
        return self._checks.towards_rest(last)

    def _as_action(self, given: ArrayLike) -> Tensor:
        action = torch.as_tensor(given, dtype=torch.float32).detach().cpu().reshape(-1)
        if len(action) != self._task.action_dim:
            raise ValueError(f"expected {self._task.action_dim} numbers, got {len(action)}.")
        return action
