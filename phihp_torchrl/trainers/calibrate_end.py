"""The end of calibration: the finalists and the actor play the same imagined episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.trainers.calibrate_budget import Price, final_steps
from phihp_torchrl.trainers.calibrate_config import CalibrateConfig
from phihp_torchrl.trainers.calibrate_rule import Choice, Finalist, choose, stretches
from phihp_torchrl.trainers.imagined_play import Player, followed_by


class End:
    """Plays lots of episodes, each as large as all before, while a choice is in doubt.

    Args:
        agent: the agent; its planner's settings are those that were given.
        config: settings of calibration.
        world_model: the model to imagine with.
        seed: seed of the noise of plans.
        price: of a plan.
        spent: what the rounds before have used of the budget.
        least: planned steps of an episode at least.
    """

    starts: Tensor
    """First states, ``[config.max_episodes, n]``."""
    late: Tensor
    """States in the second half of the actor's episodes, of the same shape."""
    length: float
    """Mean number of steps of the actor's episodes."""

    def __init__(
        self,
        agent: Agent,
        config: CalibrateConfig,
        world_model: TaskWorldModel,
        seed: int,
        price: Price,
        spent: float,
        least: int,
    ) -> None:
        assert agent.planner_config is not None
        self.agent, self.config, self.world_model = agent, config, world_model
        self.actor, self.base = agent.actor_alone(), agent.planner_config
        self.seed, self.spent, self.longest = seed, spent, agent.task.max_steps
        self.price = price
        self.steps = final_steps(config, price, config.budget - spent, least, self.longest)
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
        following = plans * steps * self.price.plan(2 * self.next_episodes)
        spent = self.spent + sum(lot["cost"] for lot in self.lots)
        return spent + following <= self.config.budget

    def play(self) -> None:
        """Let every finalist and the actor play the next lot."""
        first, count = self.episodes, self.next_episodes
        lot, seed = slice(first, first + count), self.seed + first
        starts = torch.cat([self.starts[lot], self.late[lot]])
        players, cost, longest = {}, 0.0, 0
        for name, changes in {**self.changes, "actor": None}.items():
            config = None if changes is None else replace(self.base, **changes)
            agent = self.agent.with_planner(config)
            players[name] = Player(agent, self.world_model, starts, seed)
            steps = len(players[name].play(self.steps).changes)
            if changes is not None:
                longest = max(longest, steps)
                cost += steps * self.price.plan(2 * count)
        totals = followed_by(self.actor, list(players.values()), self.longest - self.steps)
        of = {}
        for (name, player), total in zip(players.items(), totals, strict=True):
            played = player.play(self.steps)  # no more than has been played
            chatter = played.chatter(torch.zeros_like(played.lengths))
            of[name] = [row.tolist() for row in (total[:count], chatter[count:], total[count:])]
        self.lots.append({"episodes": count, "steps": longest, "cost": cost, "of": of})

    def finalists(self) -> dict[str, Finalist]:
        """What each has earned in all lots."""
        found = {}
        for name in (*self.changes, "actor"):
            returns, chatter, late = (
                tuple(value for lot in self.lots for value in lot["of"][name][index])
                for index in range(3)
            )
            weight = stretches(self.length, self.steps)
            found[name] = Finalist(returns, chatter, self.changes.get(name, {}), late, weight)
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
