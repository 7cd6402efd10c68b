"""The phase between learning and evaluation: the planner's settings are chosen in imagination."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from phihp_torchrl.config import kind_mapping
from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.planners import SearchConfig, score_sequences
from phihp_torchrl.trainers.calibrate_choice import Trial, estimate, grid, rank
from phihp_torchrl.trainers.calibrate_config import CalibrateConfig
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.imagined_play import Played, Player
from phihp_torchrl.trainers.phases import Phase, register_phase
from phihp_torchrl.trainers.run_directory import write_atomically

_log = logging.getLogger(__name__)

# States of the actor's second halves, for each episode, at which plans say what they promise.
_PROMISES = 8
_PROMISE_SHARE = 0.95


class CalibratePhase:
    """Chooses the planner's settings by paired imagined episodes, or the actor.

    Every setting of a short grid plans for some steps, from the task's starts and from states in
    the second half of the actor's episodes; then the actor takes over. In each round more steps are
    planned, by the better half of the settings. Of those within one standard error of the best the
    smoothest is chosen, and plays whole episodes: it acts if it beats the actor there by more than
    ``config.confidence`` standard errors, and else the actor does. All of this happens in the
    model, with the same starts and noise for every setting, so no real step is taken.

    Args:
        agent: the agent, with model, actor and planner; it is not compiled.
        config: settings of the phase.
        seed: seed of starts and noise.
        path: file for the table, JSON.

    Examples:
        >>> from phihp_torchrl import Agent, HybridDynamics, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> from phihp_torchrl.planners import CEMConfig
        >>> task = get_task("pendulum")
        >>> small = CEMConfig(2, optim_steps=1, num_candidates=8, top_k=2, num_policy_candidates=2)
        >>> parts = {"dynamics": HybridDynamics.hybrid(task), "actor": Actor(task)}
        >>> config = CalibrateConfig(True, episodes=2, rounds=(2,), follow_steps=2)
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
        self.actor = agent.actor_alone()
        self.base: SearchConfig = agent.planner_config
        self.world_model = TaskWorldModel(agent.task, agent.dynamics)
        self.rounds: list[list[Trial]] = [[] for _ in config.rounds]
        self.final: dict[str, Any] = {}
        self.settings: list[dict[str, Any]] = []
        self._players: dict[int, Player] = {}

    @property
    def done(self) -> bool:
        """Whether the planner is chosen."""
        return bool(self.final) or not self.config.enabled

    @property
    def progress(self) -> tuple[int, int]:
        """Trials that are done, and all of them, whole episodes being one."""
        if not self.config.enabled:
            return 0, 0
        count, total = len(self.settings) or 11, 1
        for _ in self.config.rounds:
            total, count = total + count, (count + 1) // 2
        return sum(map(len, self.rounds)) + bool(self.final), total

    @property
    def acting(self) -> str:
        """How the agent is to act, ``"planner"`` or ``"actor"``."""
        return self.final.get("acting", "planner")

    @property
    def planner_config(self) -> SearchConfig:
        """The settings of the planner that were chosen."""
        return replace(self.base, **self.final.get("changes", {}))

    def advance(self) -> dict[str, float]:
        """Try the next setting, or let the chosen one play whole episodes."""
        if not self.settings:
            self._prepare()
        for index, steps in enumerate(self.config.rounds):
            contenders = self._contenders(index)
            done = len(self.rounds[index])
            if done < len(contenders):
                number = contenders[done]
                trial = self._try(number, steps)
                self.rounds[index].append(trial)
                return {
                    "calibrate/setting": float(number),
                    "calibrate/steps": float(steps),
                    "calibrate/gain": trial.mean,
                    "calibrate/gain_error": trial.standard_error,
                    "calibrate/chatter": trial.chatter,
                }
        return self._finish()

    def parts(self) -> dict[str, Any]:
        """The planner's settings and how to act, as arguments of :class:`~phihp_torchrl.Agent`."""
        if not self.config.enabled:
            return {}
        return {
            "planner_config": self.planner_config,
            "use_planner": self.acting == "planner",
            "metadata": {"acting": self.acting, "calibration": self.final},
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything that a resumed run needs; what was planned is planned again where needed."""
        return {
            "rounds": [[asdict(trial) for trial in trials] for trials in self.rounds],
            "settings": self.settings,
            "final": self.final,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        if state["settings"]:
            self._prepare()
        self.settings = [dict(changes) for changes in state["settings"]]
        self.rounds = [[_trial(kept) for kept in trials] for trials in state["rounds"]]
        self.final = dict(state["final"])

    def _prepare(self) -> None:
        """Imagine the actor's episodes, and from these the starts and the grid."""
        task, episodes = self.agent.task, self.config.episodes
        generator = torch.Generator().manual_seed(self.seed)
        device = next(self.agent.parameters()).device
        starts = [task.sample_start([episodes], generator).to(device) for _ in range(3)]
        played = Player(self.actor, self.world_model, starts[0]).play(task.max_steps)
        share = 0.5 + 0.5 * torch.rand(_PROMISES, episodes, generator=generator).to(device)
        index = (share * played.lengths).long()
        late = played.states.gather(0, index[..., None].expand(-1, -1, task.state_dim))
        self._starts, self._whole = torch.cat([starts[1], late[0]]), starts[2]
        steps = self.config.rounds[-1] + self.config.follow_steps
        self._of_actor = Player(self.actor, self.world_model, self._starts).play(steps).total
        reward = (played.total / played.lengths).abs().mean().item()
        self.settings = grid(self.base, self._promise(late.flatten(0, 1)), reward)

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

    def _contenders(self, index: int) -> list[int]:
        """Numbers of the settings of a round: all, or the better half of the round before."""
        if index == 0:
            return list(range(len(self.settings)))
        before = rank(self.rounds[index - 1])
        better = before[: (len(before) + 1) // 2]
        return [self.settings.index(dict(trial.changes)) for trial in better]

    def _planning(self, changes: Mapping[str, Any]) -> Agent:
        return self.agent.with_planner(replace(self.base, **changes))

    def _try(self, number: int, steps: int) -> Trial:
        changes, episodes = self.settings[number], self.config.episodes
        if number not in self._players:  # a resumed run plays again what it had played
            agent = self._planning(changes)
            self._players[number] = Player(agent, self.world_model, self._starts, self.seed)
        player = self._players[number]
        played = player.play(steps)
        whole = self.config.rounds[-1] + self.config.follow_steps
        gain = player.followed_by(self.actor, whole - steps) - self._of_actor
        late = Played(
            played.states,
            played.total[episodes:],
            played.lengths[episodes:],
            played.changes[:, episodes:],
        )
        return Trial(
            changes,
            steps,
            tuple(tuple(row) for row in gain.reshape(2, episodes).tolist()),
            late.chatter(torch.zeros_like(late.lengths)),
        )

    def _finish(self) -> dict[str, float]:
        """Let the best setting play whole episodes beside the actor, and decide."""
        chosen, steps = rank(self.rounds[-1])[0], self.agent.task.max_steps
        self._players.clear()
        of_plan, of_actor = (
            Player(agent, self.world_model, self._whole, self.seed).play(steps)
            for agent in (self._planning(chosen.changes), self.actor)
        )
        gain, error = estimate((of_plan.total - of_actor.total).double()[None])
        better = gain > self.config.confidence * error
        self.final = {
            "acting": "planner" if better else "actor",
            "changes": dict(chosen.changes),
            "gain": gain,
            "gain_error": error,
            "planner_return": of_plan.total.mean().item(),
            "actor_return": of_actor.total.mean().item(),
            "planner_chatter": of_plan.chatter(of_plan.lengths // 2),
            "actor_chatter": of_actor.chatter(of_actor.lengths // 2),
        }
        self._report()
        words = {k: v for k, v in self.final.items() if isinstance(v, float)}
        metrics = {f"calibrate/{key}": value for key, value in words.items()}
        return {**metrics, "calibrate/acting_planner": float(better)}

    def _report(self) -> None:
        final = self.final
        _log.info(
            "In imagination the plan with %s earns %+.4g ± %.2g beside the actor (chatter %.3f and "
            "%.3f); the %s acts.",
            final["changes"] or "the settings as given",
            final["gain"],
            final["gain_error"],
            final["planner_chatter"],
            final["actor_chatter"],
            final["acting"],
        )
        if self.path is not None:
            table = [
                {
                    **asdict(trial),
                    "gain": trial.mean,
                    "gain_error": trial.standard_error,
                }
                for trials in self.rounds
                for trial in trials
            ]
            content = {**final, "planner": kind_mapping(self.planner_config), "trials": table}
            write_atomically(self.path, json.dumps(content, indent=2) + "\n")


def _trial(kept: Mapping[str, Any]) -> Trial:
    differences = tuple(tuple(row) for row in kept["differences"])
    return Trial(dict(kept["changes"]), kept["steps"], differences, kept["chatter"])


def _build(context: Context) -> Phase:
    parts: dict[str, Any] = {}
    for phase in context.before.values():
        parts |= getattr(phase, "parts", dict)()
    agent = Agent(context.task, **parts, planner_config=context.config.planner)
    return CalibratePhase(
        agent,
        context.settings,
        seed=context.config.seed,
        path=context.directory.path / "calibration.json",
    )


register_phase("calibrate", CalibrateConfig, _build, unit="trials")
