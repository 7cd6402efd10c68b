"""The phase between learning and evaluation: the planner's settings are chosen in imagination."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from phihp_torchrl.deployment import Agent
from phihp_torchrl.planners import RESTS, SearchConfig, score_sequences
from phihp_torchrl.trainers.calibrate_catch import CatchTrial
from phihp_torchrl.trainers.calibrate_config import CalibrateConfig
from phihp_torchrl.trainers.calibrate_contest import KNOWN, Contest
from phihp_torchrl.trainers.calibrate_report import (
    report,
    summary,
    warn_of_doubt,
    write_table,
)
from phihp_torchrl.trainers.calibrate_rule import Choice, choose, in_doubt, loses_nothing
from phihp_torchrl.trainers.calibrate_ways import LEAVING, calmer, faster, leaving
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.phases import Phase, register_phase

# Where plans promise at most the reward of so many steps beyond an actor that rests, it is left
# alone there.
_LITTLE = 3.0
# The way to plan that is as the chosen one, on the fast budget.
_FAST = "fast"
# States of the actor's second halves, for each episode, at which plans say what they promise.
_PROMISES = 8
_PROMISE_SHARE = 0.95


class CalibratePhase:
    """Chooses the planner's settings by paired imagined episodes, or the actor.

    A few ways to plan and the actor play whole episodes of the model from the same starts, with the
    same noise, and a rule (:func:`~phihp_torchrl.trainers.calibrate_rule.choose`) chooses. Where
    the actor rests in the end and plans promise little beyond it, the ways are plans that leave it
    alone there; else they are the settings as given and calmer ones, and those that leave it alone
    too if it rests. The way that is chosen plays the same episodes on the fast budget, and keeps
    that if it loses nothing. It then plays more episodes, until it is certain whether it earns more
    than the actor. No real step is taken.

    Where the agent does not come to rest, but the task has a goal in which the model would, a
    regulator acts near it in the place of plans if the agent loses nothing by it
    (:class:`~phihp_torchrl.trainers.calibrate_catch.CatchTrial`).

    Where other models that fit the data about as well say that the actor earns something else, the
    settings stay as given and the plan acts unless it is certain to earn less, and a warning says
    so: what smoothness costs is not known then.

    Args:
        agent: the agent, with model, actor and planner; it is not compiled.
        config: settings of the phase.
        seed: seed of starts and noise.
        path: file for the table, JSON.
        others: other models that fit the data about as well.

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
        self,
        agent: Agent,
        config: CalibrateConfig,
        *,
        seed: int,
        path: Path | None = None,
        others: Sequence[nn.Module] = (),
    ) -> None:
        assert agent.planner_config is not None
        self.agent, self.config, self.seed, self.path = agent, config, seed, path
        self.others = others
        self.elsewhere: list[float] = []
        """Mean returns of the actor in the other models, once they are known."""
        self.doubted = False
        """Whether they say something else than the model by which plans are made."""
        self.base: SearchConfig = agent.planner_config
        self.chosen: Choice | None = None
        """The way to plan, once all have played."""
        self.final: dict[str, Any] = {}
        generator = torch.Generator().manual_seed(seed)
        starts = agent.task.sample_start([config.max_episodes], generator)
        starts = starts.to(next(agent.parameters()).device)
        self.contest = Contest(agent, config, starts, seed)
        self.trial = CatchTrial(self.contest)

    @property
    def done(self) -> bool:
        """Whether the planner is chosen."""
        return bool(self.final)

    @property
    def progress(self) -> tuple[int, int]:
        """Episodes of plans that are played, and all that are foreseen."""
        count, total = self.contest.progress
        return count, count if self.done else max(total, count + 1)

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
        contest = self.contest
        if not contest.ways:
            contest.begin(self._ways())
        name = contest.next_way
        assert name is not None
        contest.play(name)
        way = contest.way(name)
        gain, error = way.ahead_of(contest.actor(len(way.returns)))
        metrics = {
            "way": float(list(contest.ways).index(name)),
            "episodes": float(len(way.returns)),
            "gain": gain,
            "gain_error": error,
            "chatter": way.mean_chatter,
        }
        if contest.equal:
            choice = self._decide()
            metrics["acting_planner"] = float(choice.acting == "planner")
        return {f"calibrate/{key}": value for key, value in metrics.items()}

    def parts(self) -> dict[str, Any]:
        """The planner's settings and how to act, as arguments of :class:`~phihp_torchrl.Agent`."""
        return {
            "catch": self.trial.made(self.final.get("catch")),
            "planner_config": self.planner_config,
            "use_planner": self.acting == "planner",
            "metadata": {"acting": self.acting, "calibration": self.final},
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs."""
        return {
            "contest": self.contest.state_dict(),
            "elsewhere": list(self.elsewhere),
            "doubted": self.doubted,
            "chosen": None if self.chosen is None else tuple(self.chosen),
            "trial": self.trial.state_dict(),
            "final": dict(self.final),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        self.contest.load_state_dict(state["contest"])
        self.elsewhere = list(state.get("elsewhere", ()))
        self.doubted = bool(state.get("doubted", False))
        chosen = state.get("chosen")
        self.chosen = None if chosen is None else Choice(*chosen)
        if "trial" in state:  # older checkpoints know of no regulator
            self.trial.load_state_dict(state["trial"])
        self.final = dict(state["final"])

    def _ways(self) -> dict[str, dict[str, Any]]:
        """The ways to plan, from what the actor's episodes show."""
        played, own = self.contest.of_actor, self.contest.actor(self.config.max_episodes)
        elsewhere = self.contest.actor_in(self.others)
        self.elsewhere = [way.mean_return for way in elsewhere]
        self.doubted = in_doubt(own, elsewhere, confidence=self.config.confidence)
        if self.doubted:
            warn_of_doubt(own.mean_return, self.elsewhere)
            return {"given": {}}
        reward = (played.total / played.lengths).abs().mean().item()
        alone: dict[str, dict[str, Any]] = {}
        if played.chatter().mean() <= RESTS:
            promise = self._promise(self.contest.late_states(_PROMISES))
            alone = leaving(self.base, promise, reward)
            if alone and promise <= _LITTLE * reward:
                return alone
        return {"given": {}, **alone, **calmer(self.base, reward)}

    @torch.no_grad()
    def _promise(self, state: Tensor) -> float:
        """What most plans promise beyond the actor's own sequence from these states."""
        planner, settings = self.agent.with_planner(self.base).planner, self.base
        assert planner is not None
        planner.generator = torch.Generator(state.device).manual_seed(self.seed)
        observation = self.contest.world_model.observe(state)
        seen = TensorDict(observation=observation, batch_size=[len(state)])
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

    def _decide(self) -> Choice:
        """Decide by what has been played; the choice so far."""
        if self.trial.settled is not None:
            if not self.trial.judge():
                self._record()
            return self.trial.choice
        return self._choose() if self.chosen is None else self._judge()

    def _choose(self) -> Choice:
        """Choose a way to plan; once all have played, let it alone play on, until it is known."""
        contest = self.contest
        first = next(iter(contest.ways))
        ways = {name: contest.way(name) for name in contest.playing if contest.has_played(name)}
        actor = contest.actor(contest.episodes)
        confidence = self.config.confidence
        choice = choose(ways, actor, confidence=confidence, doubted=self.doubted)
        plan = ways[choice.name]
        rests = choice.certain and choice.gain >= 0.0 and plan.mean_chatter <= RESTS
        calm = choice.name not in (first, *LEAVING)
        if rests or calm:  # this is smooth already, or the calmest that is taken
            contest.close()
        if contest.next_way is None:
            self.chosen = choice
            cheap = {} if self.doubted or choice.is_tie else faster(self.base, plan.changes)
            if cheap:
                contest.add(_FAST, cheap)
            else:
                contest.keep(choice.name)
                choice = self._judge()
        return choice

    def _judge(self) -> Choice:
        """Compare the way that is left with the actor, and let it play on until that is known."""
        contest, chosen = self.contest, self.chosen
        assert chosen is not None
        (name,) = contest.playing
        actor, confidence = contest.actor(contest.episodes), self.config.confidence
        plan = contest.way(chosen.name)
        if name == _FAST and not loses_nothing(contest.way(_FAST), plan, confidence=confidence):
            name = chosen.name
            contest.keep(name)
        left = {name: contest.way(name)}
        choice = choose(left, actor, confidence=confidence, doubted=self.doubted)
        enough = contest.episodes >= min(KNOWN, self.config.max_episodes)
        known = choice.is_tie or (choice.certain and enough)
        if known or not contest.go_on():
            self._finish(choice._replace(certain=known))
        return choice

    def _finish(self, choice: Choice) -> None:
        """Settle the choice, and let a regulator near the goal play beside it if there is one."""
        if not self.trial.begin(choice, doubted=self.doubted):
            self._record()

    def _record(self) -> None:
        """Record the choice, and the regulator near the goal if one is kept."""
        choice, actor = self.trial.choice, self.contest.actor(self.trial.episodes)
        self.final = {
            **summary(choice, self.contest.all_ways(), actor),
            "budget": _FAST if choice.name == _FAST else "given",
            "models_disagree": self.doubted,
            "actor_elsewhere": self.elsewhere,
            "catch": self.trial.record(),
        }
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
        others=[o for phase in context.before.values() for o in getattr(phase, "others", list)()],
    )


register_phase("calibrate", CalibrateConfig, _build, unit="episodes")
