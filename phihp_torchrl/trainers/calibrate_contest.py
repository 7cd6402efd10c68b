"""The imagined episodes in which ways to plan are compared with each other and with the actor."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from phihp_torchrl.baselines import TakeOver
from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.trainers.calibrate_budget import Price, first_episodes, of_ways
from phihp_torchrl.trainers.calibrate_config import CalibrateConfig
from phihp_torchrl.trainers.calibrate_rule import Way
from phihp_torchrl.trainers.imagined_play import Played, play

KNOWN = 24
"""Episodes from which on a difference of so many standard errors is taken as certain: a plan that
gains in most episodes, and fails in one of ten, shows it in that many."""

# Ways to plan that play whatever they cost; further ones do as far as the budget goes.
_IN_ANY_CASE = 3
# Episodes that a way plays whatever they cost once it is the only one left.
_ALONE = 6


class Contest:
    """Whole episodes from the same starts, with the same noise, for each way to plan.

    The actor plays all of them at once, which costs little, when it is first asked for. A way to
    plan plays lots of them, when it is told to.

    Args:
        agent: the agent, whose planner's settings the ways change, and in whose model they play.
        config: settings of calibration.
        starts: first states, ``[config.max_episodes, n]``.
        seed: seed of the noise of plans.
    """

    def __init__(
        self,
        agent: Agent,
        config: CalibrateConfig,
        starts: Tensor,
        seed: int,
    ) -> None:
        assert agent.dynamics is not None
        self.agent, self.config = agent, config
        self.world_model = TaskWorldModel(agent.task, agent.dynamics)
        self.starts, self.seed, self.price = starts, seed, Price.of(agent)
        self.ways: dict[str, dict[str, Any]] = {}
        self.catches: dict[str, TakeOver] = {}
        """The regulators that act near the goal, of the ways that have one."""
        self.playing: list[str] = []
        self.episodes, self.spent = 0, 0.0
        self._played: dict[str, list[list[float]]] = {}

    def begin(self, ways: Mapping[str, dict[str, Any]]) -> None:
        """Name the ways to plan, as changes of the planner's settings, the first one first."""
        self.ways, self.playing = dict(ways), list(ways)
        self.episodes = first_episodes(self.config, self.price, self._length, len(ways))

    @cached_property
    def of_actor(self) -> Played:
        """All episodes of the actor alone."""
        return play(self.agent.actor_alone(), self.world_model, self.starts)

    @property
    def next_way(self) -> str | None:
        """The way to plan that has yet to play; none once all have played this lot."""
        return next((name for name in self.playing if self._missing(name)), None)

    @property
    def equal(self) -> bool:
        """Whether all that play on, and have played at all, have played this lot."""
        played = (self._played[name][0] for name in self.playing if name in self._played)
        return all(len(returns) == self.episodes for returns in played)

    @property
    def progress(self) -> tuple[int, int]:
        """Episodes of plans that are played, and all of this lot and those before."""
        count = sum(len(returns) for returns, _ in self._played.values())
        return count, count + sum(map(self._missing, self.playing))

    def play(self, name: str) -> None:
        """Let a way to plan play the episodes of this lot."""
        count = self._missing(name)
        lot = slice(self.episodes - count, self.episodes)
        assert self.agent.planner_config is not None
        agent = self.agent.with_planner(replace(self.agent.planner_config, **self.ways[name]))
        agent.catch = self.catches.get(name)
        seed = self.seed + lot.start
        found = play(agent, self.world_model, self.starts[lot], seed=seed)
        self.spent += self._cost(name, count, len(found.changes))
        before = self._played.get(name, [[], []])
        new = (found.total.tolist(), found.chatter().tolist())
        self._played[name] = [[*old, *more] for old, more in zip(before, new, strict=True)]

    def go_on(self) -> bool:
        """Go on to :data:`KNOWN` episodes, or to twice as many, as far as limit and budget allow.

        Returns:
            Whether there are more.
        """
        more = max(self.episodes, KNOWN - self.episodes)
        most = min(more, self.config.max_episodes - self.episodes)
        left = self.config.budget - self.spent
        paid = (n for n in range(most, 0, -1) if self._cost_of_all(n) <= left)
        more = max(next(paid, 0), min(_ALONE - self.episodes, most))
        self.episodes += max(more, 0)
        return more > 0

    def add(self, name: str, changes: Mapping[str, Any], catch: TakeOver | None = None) -> None:
        """Let one more way to plan play as many episodes as the last ones have.

        Args:
            name: its name.
            changes: what it changes in the settings of the planner.
            catch: what acts near the goal in the place of its plans.
        """
        self.ways[name] = dict(changes)
        if catch is not None:
            self.catches[name] = catch
        self.playing, self._played[name] = [name], [[], []]

    def close(self) -> None:
        """Let no further way to plan enter."""
        self.playing = [name for name in self.playing if name in self._played]

    def keep(self, name: str) -> None:
        """Let one way to plan alone play on."""
        self.playing = [name]

    def has_played(self, name: str) -> bool:
        """Whether a way to plan has played at all."""
        return name in self._played

    def way(self, name: str) -> Way:
        """What a way to plan has earned so far."""
        returns, chatter = self._played[name]
        return Way(tuple(returns), tuple(chatter), self.ways[name])

    def all_ways(self) -> dict[str, Way]:
        """What all that have played have earned."""
        return {name: self.way(name) for name in self._played}

    def actor_in(self, others: Sequence[nn.Module]) -> list[Way]:
        """What the actor earns from all starts in other models."""
        models = (TaskWorldModel(self.agent.task, other) for other in others)
        alone = self.agent.actor_alone()
        return [_way(play(alone, model, self.starts)) for model in models]

    def late_states(self, count: int) -> Tensor:
        """States of the second halves of the actor's first episodes, ``[count * episodes, n]``."""
        episodes, played = self.config.episodes, self.of_actor
        generator = torch.Generator().manual_seed(self.seed)
        states = played.states[:, :episodes]
        share = 0.5 + 0.5 * torch.rand(count, episodes, generator=generator).to(states.device)
        index = (share * played.lengths[:episodes]).long()[..., None]
        return states.gather(0, index.expand(-1, -1, states.shape[-1])).flatten(0, 1)

    def actor(self, episodes: int) -> Way:
        """What the actor earned in the first episodes."""
        return _way(self.of_actor, episodes)

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs; the actor's episodes are played again."""
        names = ("ways", "playing", "episodes", "spent", "_played")
        return {name: copy.deepcopy(getattr(self, name)) for name in names}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self.playing = list(state["ways"])  # older checkpoints do not say
        for name, value in state.items():
            setattr(self, name, copy.deepcopy(value))

    @property
    def _length(self) -> float:
        """Mean length of the actor's episodes, as long as which a plan's are taken to be."""
        return self.of_actor.lengths.double().mean().item()

    def _missing(self, name: str) -> int:
        """Episodes that a way has yet to play; none of one that would exceed the budget."""
        played = self._played.get(name)
        if played is not None:
            return self.episodes - len(played[0])
        optional = list(self.ways).index(name) >= _IN_ANY_CASE
        cost = self._cost(name, self.episodes, self._length)
        dear = self.spent + cost > of_ways(self.config)
        return 0 if optional and dear else self.episodes

    def _cost_of_all(self, episodes: int) -> float:
        return sum(self._cost(name, episodes, self._length) for name in self.playing)

    def _cost(self, name: str, episodes: int, steps: float) -> float:
        planner = replace(self.price.planner, **self.ways[name])
        return steps * replace(self.price, planner=planner).plan(episodes)


def _way(played: Played, episodes: int | None = None) -> Way:
    """What was earned in the first episodes, or in all of them."""
    numbers = (played.total, played.chatter())
    returns, chatter = (tuple(column[:episodes].tolist()) for column in numbers)
    return Way(returns, chatter)
