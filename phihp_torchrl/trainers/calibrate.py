"""The phase between learning and evaluation: the planner's settings are chosen in imagination."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.planners import SearchConfig, score_sequences
from phihp_torchrl.trainers.calibrate_budget import Price, first_episodes
from phihp_torchrl.trainers.calibrate_config import CalibrateConfig
from phihp_torchrl.trainers.calibrate_report import report, summary, write_table
from phihp_torchrl.trainers.calibrate_rule import Choice, Way, choose
from phihp_torchrl.trainers.calibrate_ways import calmer, leaving
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.imagined_play import Played, play
from phihp_torchrl.trainers.phases import Phase, register_phase

# An actor rests that has at most this chatter in the second halves of its episodes, where plans
# promise at most the reward of so many steps beyond it.
_RESTS, _LITTLE = 0.02, 3.0
# States of the actor's second halves, for each episode, at which plans say what they promise.
_PROMISES = 8
_PROMISE_SHARE = 0.95
# Ways to plan that are tried whatever they cost; further ones as far as the budget goes.
_IN_ANY_CASE = 2


class CalibratePhase:
    """Chooses the planner's settings by paired imagined episodes, or the actor.

    A few ways to plan and the actor play whole episodes of the model from the same starts, with the
    same noise, and a rule (:func:`~phihp_torchrl.trainers.calibrate_rule.choose`) chooses. Where
    the actor rests in the end, and plans promise little beyond it, the one way is a plan that
    leaves it alone there; else there are the settings as given and calmer ones. More episodes are
    played while it is in doubt who is to act. No real step is taken.

    Args:
        agent: the agent, with model, actor and planner; it is not compiled.
        config: settings of the phase.
        seed: seed of starts and noise.
        path: file for the table, JSON.

    Examples:
        >>> from phihp_torchrl import Agent, HybridDynamics, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> from phihp_torchrl.planners import CEMConfig
        >>> from dataclasses import replace
        >>> task = replace(get_task("pendulum"), max_steps=10)
        >>> small = CEMConfig(2, optim_steps=1, num_candidates=8, top_k=2, num_policy_candidates=2)
        >>> parts = {"dynamics": HybridDynamics.hybrid(task), "actor": Actor(task)}
        >>> config = CalibrateConfig(True, 2, max_episodes=2, budget=1)
        >>> phase = CalibratePhase(Agent(task, **parts, planner_config=small), config, seed=0)
        >>> while not phase.done:
        ...     metrics = phase.advance()
        >>> phase.acting in ("planner", "actor"), phase.progress[0] == phase.progress[1]
        (True, True)
    """

    def __init__(
        self, agent: Agent, config: CalibrateConfig, *, seed: int, path: Path | None = None
    ) -> None:
        assert agent.dynamics is not None
        assert agent.planner_config is not None
        self.agent, self.config, self.seed, self.path = agent, config, seed, path
        self.base: SearchConfig = agent.planner_config
        self.world_model = TaskWorldModel(agent.task, agent.dynamics)
        self.price = Price.of(agent)
        self.ways: dict[str, dict[str, Any]] = {}
        self.played: dict[str, list[list[float]]] = {}
        self.spent, self.episodes = 0.0, 0
        self.final: dict[str, Any] = {}
        self._starts: Tensor | None = None
        self._of_actor: Played | None = None

    @property
    def done(self) -> bool:
        """Whether the planner is chosen."""
        return bool(self.final)

    @property
    def progress(self) -> tuple[int, int]:
        """Episodes that are played, and all that are foreseen."""
        count = sum(len(of[0]) for of in self.played.values())
        return count, count if self.done else max(len(self.ways) * self.episodes, count + 1)

    @property
    def acting(self) -> str:
        """How the agent is to act, ``"planner"`` or ``"actor"``."""
        return self.final.get("acting", "planner")

    @property
    def planner_config(self) -> SearchConfig:
        """The settings of the planner that were chosen."""
        return replace(self.base, **self.final.get("changes", {}))

    def advance(self) -> dict[str, float]:
        """Let the next way to plan play its episodes, and choose once all have."""
        if self._starts is None:
            self._prepare()
        name = next(name for name in self.ways if self._missing(name))
        self._play(name)
        way, actor = self._way(name), self._actor(name)
        gain, error = way.ahead_of(actor)
        metrics = {
            "way": float(list(self.ways).index(name)),
            "episodes": float(len(way.returns)),
            "gain": gain,
            "gain_error": error,
            "chatter": way.mean_chatter,
        }
        if not any(map(self._missing, self.ways)):
            metrics |= self._choose()
        return {f"calibrate/{key}": value for key, value in metrics.items()}

    def parts(self) -> dict[str, Any]:
        """The planner's settings and how to act, as arguments of :class:`~phihp_torchrl.Agent`."""
        return {
            "planner_config": self.planner_config,
            "use_planner": self.acting == "planner",
            "metadata": {"acting": self.acting, "calibration": self.final},
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs."""
        names = ("ways", "played", "spent", "episodes", "final")
        return {name: copy.deepcopy(getattr(self, name)) for name in names}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        for name, value in state.items():
            setattr(self, name, copy.deepcopy(value))

    def _prepare(self) -> None:
        """Imagine the actor's episodes, and from these the ways to plan."""
        task, config = self.agent.task, self.config
        generator = torch.Generator().manual_seed(self.seed)
        device = next(self.agent.parameters()).device
        starts = task.sample_start([config.max_episodes], generator).to(device)
        actor, steps = self.agent.actor_alone(), task.max_steps
        played = play(actor, self.world_model, starts, steps=steps)
        self._starts, self._of_actor = starts, played
        if self.ways:  # a resumed run has them
            return
        share = 0.5 + 0.5 * torch.rand(_PROMISES, config.episodes, generator=generator).to(device)
        index = (share * played.lengths[: config.episodes]).long()[..., None]
        states = played.states[:, : config.episodes]
        late = states.gather(0, index.expand(-1, -1, task.state_dim)).flatten(0, 1)
        reward = (played.total / played.lengths).abs().mean().item()
        promise = self._promise(late)
        margin = leaving(self.base, promise, reward)
        if margin and played.chatter().mean() <= _RESTS and promise <= _LITTLE * reward:
            self.ways = {"leaving": margin}
        else:
            self.ways = {"given": {}, **calmer(self.base, reward)}
        self.episodes = first_episodes(config, self.price, self._longest, len(self.ways))

    @torch.no_grad()
    def _promise(self, state: Tensor) -> float:
        """What most plans promise beyond the actor's own sequence from these states."""
        planner, settings = self._planning({}).planner, self.base
        assert planner is not None
        planner.generator = torch.Generator(state.device).manual_seed(self.seed)
        seen = TensorDict(observation=self.world_model.observe(state), batch_size=[len(state)])
        none = state.new_zeros(settings.planning_horizon, len(state), self.agent.task.action_dim)
        own, _ = score_sequences(
            state,
            none,
            planner.problem(),
            gamma=settings.gamma,
            alpha=settings.alpha,
            policy_noise=none,
            change_cost=settings.change_cost,
        )
        gain = (planner.plan(seen).score - own).clamp_min(0)
        gain = gain[gain.isfinite()]
        return gain.quantile(_PROMISE_SHARE).item() if len(gain) else 0.0

    def _planning(self, changes: Mapping[str, Any]) -> Agent:
        return self.agent.with_planner(replace(self.base, **changes))

    def _missing(self, name: str) -> int:
        """Episodes that a way has yet to play; none of one that would exceed the budget."""
        count = self.episodes - len(self.played.get(name, [[]])[0])
        dear = self.spent + self._cost(count, self._longest) > self.config.budget
        optional = name not in self.played and list(self.ways).index(name) >= _IN_ANY_CASE
        return 0 if dear and optional else count

    @property
    def _longest(self) -> int:
        """Steps of the longest of the actor's episodes, as which a plan's are taken to be."""
        assert self._of_actor is not None
        return len(self._of_actor.changes)

    def _cost(self, episodes: int, steps: int) -> float:
        return steps * self.price.plan(episodes) if episodes else 0.0

    def _play(self, name: str) -> None:
        """Let a way to plan play the episodes that it misses."""
        assert self._starts is not None
        count, steps = self._missing(name), self.agent.task.max_steps
        lot = slice(self.episodes - count, self.episodes)
        agent, seed = self._planning(self.ways[name]), self.seed + lot.start
        found = play(agent, self.world_model, self._starts[lot], steps=steps, seed=seed)
        self.spent += self._cost(count, len(found.changes))
        before = self.played.get(name, [[], []])
        new = (found.total.tolist(), found.chatter().tolist())
        self.played[name] = [[*old, *more] for old, more in zip(before, new, strict=True)]

    def _way(self, name: str) -> Way:
        returns, chatter = map(tuple, self.played[name])
        return Way(returns, chatter, self.ways[name])

    def _actor(self, beside: str) -> Way:
        """What the actor earned in the episodes that a way to plan has played."""
        assert self._of_actor is not None
        count, played = len(self.played[beside][0]), self._of_actor
        return Way(tuple(played.total[:count].tolist()), tuple(played.chatter()[:count].tolist()))

    def _choose(self) -> dict[str, float]:
        """Choose, or ask for as many episodes again."""
        ways = {name: self._way(name) for name in self.played}
        actor = self._actor(next(iter(ways)))
        choice = choose(ways, actor, confidence=self.config.confidence)
        if not choice.certain and self._may_go_on():
            self.episodes = min(2 * self.episodes, self.config.max_episodes)
            self.ways = {name: self.ways[name] for name in ways}
        else:
            self._end(choice, ways, actor)
        return {"acting_planner": float(choice.acting == "planner")}

    def _may_go_on(self) -> bool:
        """Whether the limit of episodes and the budget allow as many episodes again."""
        each = self.spent / max(1, self.episodes)
        more = min(self.episodes, self.config.max_episodes - self.episodes)
        return more > 0 and self.spent + each * more <= self.config.budget

    def _end(self, choice: Choice, ways: Mapping[str, Way], actor: Way) -> None:
        self.final = summary(choice, ways, actor)
        report(self.final)
        if self.path is not None:
            write_table(self.path, self.final, self.planner_config)


def _build(context: Context) -> Phase:
    agent = Agent(context.task, **context.parts, planner_config=context.planner)
    return CalibratePhase(
        agent,
        context.settings,
        seed=context.config.seed,
        path=context.directory.path / "calibration.json",
    )


register_phase("calibrate", CalibrateConfig, _build, unit="episodes")
