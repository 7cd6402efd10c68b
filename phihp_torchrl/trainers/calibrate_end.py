"""The end of calibration: the finalists and the actor play the same imagined episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.trainers.calibrate_budget import final_steps, plan_cost
from phihp_torchrl.trainers.calibrate_config import CalibrateConfig
from phihp_torchrl.trainers.calibrate_rule import Choice, Finalist, choose
from phihp_torchrl.trainers.imagined_play import Played, Player


class End:
    """Plays lots of episodes, each as large as all before, while a choice is in doubt.

    Args:
        agent: the agent; its planner's settings are those that were given.
        config: settings of calibration.
        world_model: the model to imagine with.
        seed: seed of the noise of plans.
        spent: what the rounds before have used of the budget.
    """

    starts: Tensor
    """First states, ``[config.max_episodes, n]``."""
    late: Tensor
    """States in the second half of the actor's episodes, of the same shape."""

    def __init__(
        self,
        agent: Agent,
        config: CalibrateConfig,
        world_model: TaskWorldModel,
        seed: int,
        spent: float,
    ) -> None:
        assert agent.planner_config is not None
        self.agent, self.config, self.world_model = agent, config, world_model
        self.actor, self.base = agent.actor_alone(), agent.planner_config
        self.seed, self.spent, self.longest = seed, spent, agent.task.max_steps
        self.steps = final_steps(config, self.base, config.budget - spent, self.longest)
        self.changes: dict[str, dict[str, Any]] = {}
        self.lots: list[dict[str, Any]] = []

    @property
    def episodes(self) -> int:
        """Episodes that each finalist has played."""
        return sum(lot["episodes"] for lot in self.lots)

    @property
    def next_episodes(self) -> int:
        """Episodes of the next lot."""
        return min(self.episodes or self.config.episodes, self.config.max_episodes - self.episodes)

    def may_go_on(self) -> bool:
        """Whether the limit of episodes and the budget allow another lot."""
        if not self.next_episodes:
            return False
        plans, steps = len(self.changes), max(lot["steps"] for lot in self.lots)
        following = plans * steps * plan_cost(self.base, 2 * self.next_episodes)
        spent = self.spent + sum(lot["cost"] for lot in self.lots)
        return spent + following <= self.config.budget

    def play(self) -> None:
        """Let every finalist and the actor play the next lot."""
        first, count = self.episodes, self.next_episodes
        lot, seed = slice(first, first + count), self.seed + first
        starts = torch.cat([self.starts[lot], self.late[lot]])
        of, cost, longest = {}, 0.0, 0
        for name, changes in self.changes.items():
            agent = self.agent.with_planner(replace(self.base, **changes))
            player = Player(agent, self.world_model, starts, seed)
            played = player.play(self.steps)
            of[name] = self._found(player, played, count)
            longest = max(longest, len(played.changes))
            cost += len(played.changes) * plan_cost(self.base, 2 * count)
        player = Player(self.actor, self.world_model, starts)
        of["actor"] = self._found(player, player.play(self.steps), count)
        plain = {name: [row.tolist() for row in rows] for name, rows in of.items()}
        self.lots.append({"episodes": count, "steps": longest, "cost": cost, "of": plain})

    def _found(self, player: Player, played: Played, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Returns of episodes, chatter late in them, and returns of the late stretches."""
        total = player.followed_by(self.actor, self.longest - self.steps)
        chatter = played.chatter(played.lengths // 2)
        return total[:count], chatter[count:], total[count:]

    def finalists(self) -> dict[str, Finalist]:
        """What each has earned in all lots."""
        found = {}
        for name in (*self.changes, "actor"):
            returns, chatter, late = (
                tuple(value for lot in self.lots for value in lot["of"][name][index])
                for index in range(3)
            )
            found[name] = Finalist(returns, chatter, self.changes.get(name, {}), late)
        return found

    def choice(self) -> Choice:
        """What the rule chooses after all lots."""
        ways, confidence = self.finalists(), self.config.confidence
        return choose(ways["given"], ways.get("other"), ways["actor"], confidence=confidence)

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs."""
        return {"changes": self.changes, "lots": self.lots}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self.changes = {name: dict(changes) for name, changes in state["changes"].items()}
        self.lots = [dict(lot) for lot in state["lots"]]
