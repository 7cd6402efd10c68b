"""The phase between learning and evaluation: the planner's settings are chosen in imagination."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from phihp_torchrl.deployment import Agent
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.planners import SearchConfig, score_sequences
from phihp_torchrl.trainers.calibrate_budget import Price, fit_rounds, rounds_cost
from phihp_torchrl.trainers.calibrate_choice import Trial, grid, rank
from phihp_torchrl.trainers.calibrate_config import CalibrateConfig
from phihp_torchrl.trainers.calibrate_end import End
from phihp_torchrl.trainers.calibrate_report import report, summary, write_table
from phihp_torchrl.trainers.calibrate_rule import late_weight, stretches
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.imagined_play import Played, Player
from phihp_torchrl.trainers.phases import Phase, register_phase

# States of the actor's second halves, for each episode, at which plans say what they promise.
_PROMISES = 8
_PROMISE_SHARE = 0.95


class CalibratePhase:
    """Chooses the planner's settings by paired imagined episodes, or the actor.

    Every setting of a short grid plans for some steps, from the task's starts and from states in
    the second half of the actor's episodes; then the actor takes over. In each round more steps are
    planned, by the better half of the settings. The first of the last round, the settings as given
    and the actor then play on from other states of both sorts, from more of them while it is in
    doubt who is to act, and a rule chooses. All of this happens in the model, with the same starts
    and noise for every setting, so no real step is taken.

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
        >>> config = CalibrateConfig(True, 2, rounds=(2,), follow_steps=2, max_episodes=2, budget=1)
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
        self._count = len(grid(self.base, 1.0, 1.0))  # of settings, at most
        price = Price.of(agent)
        self._steps, self._episodes = fit_rounds(config, price, self._count)
        spent = rounds_cost(config, price, self._steps, self._episodes, self._count)
        self.end = End(agent, config, self.world_model, seed, price, spent, self._steps[-1])

    @property
    def done(self) -> bool:
        """Whether the planner is chosen."""
        return bool(self.final)

    @property
    def progress(self) -> tuple[int, int]:
        """Trials that are done, and all that are foreseen; at the end, each lot of episodes."""
        count, total = len(self.settings) or self._count, 0
        for _ in self.config.rounds:
            total, count = total + count, (count + 1) // 2
        stages = len(self.end.lots)
        return sum(map(len, self.rounds)) + stages, total + stages + (not self.done)

    @property
    def acting(self) -> str:
        """How the agent is to act, ``"planner"`` or ``"actor"``."""
        return self.final.get("acting", "planner")

    @property
    def planner_config(self) -> SearchConfig:
        """The settings of the planner that were chosen."""
        return replace(self.base, **self.final.get("changes", {}))

    def advance(self) -> dict[str, float]:
        """Try the next setting, or let the finalists play some episodes."""
        if not self.settings:
            self._prepare()
        for index, steps in enumerate(self._steps):
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
        return self._play_final()

    def parts(self) -> dict[str, Any]:
        """The planner's settings and how to act, as arguments of :class:`~phihp_torchrl.Agent`."""
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
            "end": self.end.state_dict(),
            "final": self.final,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a :meth:`state_dict`."""
        if state["settings"]:
            self._prepare()
        self.settings = [dict(changes) for changes in state["settings"]]
        self.rounds = [[_trial(kept) for kept in trials] for trials in state["rounds"]]
        self.end.load_state_dict(state["end"])
        self.final = dict(state["final"])

    def _prepare(self) -> None:
        """Imagine the actor's episodes, and from these the starts and the grid."""
        task, episodes = self.agent.task, self._episodes
        generator = torch.Generator().manual_seed(self.seed)
        device = next(self.agent.parameters()).device
        most = self.config.max_episodes
        counts = (episodes + most, episodes, most)
        starts = [task.sample_start([count], generator).to(device) for count in counts]
        played = Player(self.actor, self.world_model, starts[0]).play(task.max_steps)
        share = 0.5 + 0.5 * torch.rand(_PROMISES, counts[0], generator=generator).to(device)
        index = (share * played.lengths).long()
        late = played.states.gather(0, index[..., None].expand(-1, -1, task.state_dim))
        self._starts = torch.cat([starts[1], late[0, :episodes]])
        self.end.starts, self.end.late = starts[2], late[0, episodes:]
        late = late[:, :episodes]
        self.end.length = played.lengths.double().mean().item()
        steps = self._steps[-1] + self.config.follow_steps
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
        changes, episodes = self.settings[number], self._episodes
        if number not in self._players:  # a resumed run plays again what it had played
            agent = self._planning(changes)
            self._players[number] = Player(agent, self.world_model, self._starts, self.seed)
        player = self._players[number]
        played = player.play(steps)
        whole = self._steps[-1] + self.config.follow_steps
        gain = player.followed_by(self.actor, whole - steps) - self._of_actor
        gain = gain.reshape(2, episodes)
        gain[1] *= late_weight(gain, stretches(self.end.length, steps))
        late = Played(
            played.states,
            played.total[episodes:],
            played.lengths[episodes:],
            played.changes[:, episodes:],
        )
        return Trial(
            changes,
            steps,
            tuple(tuple(row) for row in gain.tolist()),
            late.chatter(torch.zeros_like(late.lengths)).mean().item(),
        )

    def _play_final(self) -> dict[str, float]:
        """Let the finalists play episodes of the end, and choose once there are enough."""
        self._players.clear()
        if not self.end.changes:
            others = [trial.changes for trial in rank(self.rounds[-1]) if trial.changes]
            self.end.changes = {"given": {}, **({"other": dict(others[0])} if others else {})}
        self.end.play()
        choice = self.end.choice()
        if choice.certain or not self.end.may_go_on():
            self.final = summary(choice, self.end)
            report(self.final)
            if self.path is not None:
                write_table(self.path, self.final, self.planner_config, self.rounds)
        numbers = {name: value for name, value in self.final.items() if isinstance(value, float)}
        numbers |= {"gain": choice.gain, "gain_error": choice.gain_error}
        return {
            "calibrate/episodes": float(self.end.episodes),
            **{f"calibrate/{name}": value for name, value in numbers.items()},
            "calibrate/acting_planner": float(choice.acting == "planner"),
        }


def _trial(kept: Mapping[str, Any]) -> Trial:
    differences = tuple(tuple(row) for row in kept["differences"])
    return Trial(dict(kept["changes"]), kept["steps"], differences, kept["chatter"])


def _build(context: Context) -> Phase:
    agent = Agent(context.task, **context.parts, planner_config=context.planner)
    return CalibratePhase(
        agent,
        context.settings,
        seed=context.config.seed,
        path=context.directory.path / "calibration.json",
    )


register_phase("calibrate", CalibrateConfig, _build, unit="trials")
