"""The last phase: evaluate the agent with its planner and with its actor, save it, show it."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from phihp_torchrl.baselines import check_names
from phihp_torchrl.config import check_count, check_fields, check_memory, digest_of
from phihp_torchrl.deployment import Agent, AgentError, load_agent, save_agent
from phihp_torchrl.evaluation import (
    BASELINES_KEY,
    EVALUATION_SEED,
    Episode,
    controllers_table,
    evaluate,
    measure_latency,
    play_baselines,
    show_episode,
    warn_of_slow_plans,
)
from phihp_torchrl.trainers.collect import CollectConfig
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.files import write_atomically
from phihp_torchrl.trainers.packaging import Packaging, packages_plan
from phihp_torchrl.trainers.phases import Phase, real_steps, register_phase
from phihp_torchrl.trainers.return_curve import read_rows, return_curve
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.worlds import GuardedWorld, World, crossings_text

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class EvaluateConfig:
    """Settings of the last phase, in which the trained agent is evaluated.

    Args:
        episodes: real episodes, from seeds that no training uses.
        first_seed: seed of these episodes.
        latency_actions: actions whose time is measured, one at a time; 0 for none.
        packaged: whether the plan is compiled into a package beside the saved agent, with which
            load_agent plans at once, by another process while the episodes are played; auto on the
            CPU after a minute of training, where a core is to spare.
        video: whether to write a GIF of an episode (needs the extra rendering).
        baselines: controllers by hand to play beside the agent, built in its model; auto (the quick
            ones that apply, in a simulated world), none, or a list of their names.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> EvaluateConfig(episodes=0)
        Traceback (most recent call last):
        ...
        phihp_torchrl.config.ConfigError: episodes: expected a whole number >= 1, got 0.
    """

    episodes: int = 50
    first_seed: int = EVALUATION_SEED
    latency_actions: int = 200
    packaged: bool | Literal["auto"] = "auto"
    video: bool = True
    baselines: str | tuple[str, ...] = "auto"

    def __post_init__(self) -> None:
        check_fields(self)
        check_count(self, "episodes")
        check_count(self, "first_seed", least=EVALUATION_SEED)
        check_count(self, "latency_actions", least=0)
        check_memory(self, "episodes")
        check_memory(self, "latency_actions", each=2)  # times of float64
        check_names(self.baselines)


class NewFile(NamedTuple):
    """A file or directory for the logger.

    Args:
        label: its name in the logger.
        path: path of the file or directory.
    """

    label: str
    path: Path


class EvaluatePhase:
    """Evaluates the agent with its planner and with its actor, if it has them; saves and shows it.

    Args:
        agent: the agent.
        config: settings of the run.
        settings: the section of this phase.
        world: the world in which the agent plays; in one of recordings it is saved alone.
        directory: directory of the run, for agent, pictures and ``evaluation.json``.
        samples: real steps that were taken to train the agent.
        packaged: whether the plan is compiled into a package beside the agent.
    """

    def __init__(
        self,
        agent: Agent,
        config: RunConfig,
        settings: EvaluateConfig,
        world: World,
        directory: RunDirectory,
        samples: int,
        packaged: bool = False,
    ) -> None:
        self.agent = agent
        self.config = config
        self.settings = settings
        self.world = world
        self.directory = directory
        self.samples = samples
        self.packaged = packaged
        self.results: dict[str, dict[str, Any]] = {}
        self.beside: dict[str, dict[str, Any]] = {}
        self.new_files: list[NewFile] = []
        self._played: Episode | None = None
        self._packaging: Packaging | None = None
        self._steps: list[tuple[str, Agent]] = []
        if agent.planner is not None and world.has_env:
            self._steps.append(("planner", agent))
        if agent.actor is not None and world.has_env:
            self._steps.append(("actor", agent.actor_alone()))
        self._finished = False

    @property
    def progress(self) -> tuple[int, int]:
        """Number of finished units of work, and of all units."""
        return len(self.results) + self._finished, len(self._steps) + 1

    @property
    def done(self) -> bool:
        """Whether everything is evaluated, saved and shown."""
        return self._finished

    def advance(self) -> dict[str, float]:
        """Evaluate the planner, or else the actor, or else save and show the agent."""
        self.new_files = []
        if self.packaged and self._packaging is None:
            self._packaging = Packaging(self.agent)
        if len(self.results) < len(self._steps):
            return self._evaluate(*self._steps[len(self.results)])
        self._write()  # before anything that may fail or wait
        metrics = self._take_package() | self._missing_latency()
        self.beside = self._beside()
        self._write()
        label = f"{self.config.task}-{self.config.label}"
        self.new_files.append(NewFile(label, self.directory.agent))
        if self.world.has_env:
            self._show()
        else:
            _log.warning(
                "%s has recordings alone: the agent is saved without having played in it.",
                self.world,
            )
        self._finished = True
        return metrics | {
            f"evaluate/{name}/{key}": value
            for name, result in self.beside.items()
            for key, value in result.items()
            if key != "returns"
        }

    @property
    def digests(self) -> dict[str, str]:
        """The digests of files that are read again, for the record of the run."""
        return {self.directory.evaluation.name: digest_of(self._text())}

    def state_dict(self) -> dict[str, Any]:
        played = {} if self._played is None else {"played": self._played.to_tensors()}
        state = {"results": self.results, "beside": self.beside, "finished": self._finished}
        return {**state, **played}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.results = dict(state["results"])
        self.beside = dict(state.get("beside", {}))
        self._finished = bool(state["finished"])
        if "played" in state:
            self._played = Episode.from_tensors(self.agent.task, state["played"])

    def restore_files(self) -> None:
        """Write the files of a finished phase again that are gone or damaged since."""
        place = self.directory.evaluation
        if not place.is_file() or place.read_bytes() != self._text().encode():
            _log.warning("%s is gone or damaged, and is written again.", place)
            write_atomically(place, self._text())
        try:
            load_agent(self.directory.agent, task=self.agent.task, packaged=False)
        except AgentError as error:
            _log.warning("%s The agent is saved again.", error)
            self._save_agent()

    def _evaluate(self, name: str, agent: Agent) -> dict[str, float]:
        settings, task = self.settings, self.agent.task
        played = evaluate(
            _eager(agent) if self.world.copies or self._packaging else agent,
            task,
            episodes=settings.episodes,
            seed=settings.first_seed,
            # The episodes are those of every run, and the planner's noise is the run's own.
            noise_seed=settings.first_seed + self.config.seed,
            world=self.world,
        )
        if isinstance(self.world, GuardedWorld) and self.world.crossings:
            text = crossings_text(self.world.crossings)
            self.world.crossings.clear()
            _log.warning(
                "Guards ended episodes of the agent's %s, whose returns are therefore too short: "
                "%s. The reward should keep it from where the guards are.",
                name,
                text,
            )
        summary = played.summary()
        if self._packaging is None or agent.planner is None:  # else once it plans as it will later
            summary |= self._latency(agent)
        self.results[name] = {**summary, "returns": played.returns.tolist()}
        self._played = self._played or played.first
        return {f"evaluate/{name}/{key}": value for key, value in summary.items()}

    def _latency(self, agent: Agent) -> dict[str, float]:
        if not (calls := self.settings.latency_actions):
            return {}
        summary = measure_latency(agent, self.agent.task, calls=calls).summary()
        warn_of_slow_plans(agent, summary["latency_ms_p50"])
        return summary

    def _take_package(self) -> dict[str, float]:
        """Wait for the package, and put it beside the agent."""
        if self._packaging is None:
            return {}
        packaged = self._packaging.take(self.directory.agent)
        if "planner" in self.results:  # it has played
            self.results["planner"]["packaged"] = packaged
        return {"evaluate/planner/packaged": float(packaged)}

    def _missing_latency(self) -> dict[str, float]:
        """The time of a plan, where it was to be measured with the package."""
        planner = self.results.get("planner")
        if planner is None or "latency_ms_mean" in planner:
            return {}
        latency = self._latency(self.agent)
        planner.update(latency)
        return {f"evaluate/planner/{key}": value for key, value in latency.items()}

    def _beside(self) -> dict[str, dict[str, Any]]:
        """Play the baselines in the same episodes."""
        settings = self.settings
        beside = play_baselines(
            self.agent,
            self.world,
            settings.baselines,
            episodes=settings.episodes,
            seed=settings.first_seed,
            latency_actions=settings.latency_actions,
        )
        if beside:
            table = controllers_table("controller", {**self.results, **beside})
            _log.info("The agent beside controllers by hand in its model:\n%s", table)
        elif self.agent.task.constraints and self.results:
            table = controllers_table("controller", self.results)
            _log.info("The agent, and its violations of constraints:\n%s", table)
        return beside

    def _write(self) -> None:
        """Write the agent and ``evaluation.json``, with what is known of them so far."""
        self._save_agent()
        write_atomically(self.directory.evaluation, self._text())

    def _save_agent(self) -> None:
        origin = (self.directory.read_metadata().get("sessions") or [{}])[0]
        metadata = {
            "seed": self.config.seed,
            "commit": origin.get("commit"),
            "dirty": origin.get("dirty"),
            "command": origin.get("command"),
            "samples": self.samples,
            "config": _public(self.config.to_mapping()),
            "returns": _as_json(self.results),
            **self.agent.metadata,
        }
        save_agent(self.agent, self.directory.agent, metadata=metadata)

    def _text(self) -> str:
        """The content of ``evaluation.json``."""
        results = {**self.results, **({BASELINES_KEY: self.beside} if self.beside else {})}
        return json.dumps(_as_json(results), indent=2) + "\n"

    def _show(self) -> None:
        video, place = self.settings.video, self.directory.path
        # Single plans are compiled already if their time was measured.
        agent = self.agent if self.settings.latency_actions else _eager(self.agent)
        curve = return_curve(read_rows(self.directory.metrics))
        files = show_episode(
            agent, place, world=self.world, video=video, curve=curve, played=self._played
        )
        for path in files:
            self.new_files.append(NewFile(f"evaluate/{path.stem}{path.suffix}", path))


def _eager(agent: Agent) -> Agent:
    """The agent with a plan that is not compiled.

    A plan for all episodes at once is nearly all arithmetic: its graph would take as long to
    compile as the episodes take, and save little. Only single plans are compiled, of which the time
    is measured, and in worlds of which there is one, which is played episode after episode.
    """
    if agent.planner is None or type(agent) is not Agent:  # another sort may plan otherwise
        return agent
    return agent.with_planner(agent.planner_config)


def _as_json(value: Any) -> Any:
    """Plain values with null in the place of numbers that are not finite, which JSON lacks."""
    if isinstance(value, Mapping):
        return {key: _as_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _public(config: dict[str, Any]) -> dict[str, Any]:
    """Return the settings without those that matter only on this machine."""
    private = ("from", "plugins", "logger", "progress", "checkpoint_interval", "keep_checkpoints")
    return {key: value for key, value in config.items() if key not in private}


def _build(context: Context) -> Phase:
    parts = context.parts
    config, agent = context.config, parts.get("agent")
    if agent is None:
        parts = {"planner_config": context.planner, "compile": context.compile, **parts}
        agent = Agent(context.task, **parts)
    world, samples = context.world, real_steps(context.before)
    collect = getattr(config.sections.get("model"), "collect", None)
    guards = collect.exploration.guards if isinstance(collect, CollectConfig) else {}
    if guards and world.truth is None:  # a simulated world is played as a model, which needs none
        world = GuardedWorld(world, guards)
    packaged = packages_plan(context, agent)
    return EvaluatePhase(
        agent, config, context.settings, world, context.directory, samples, packaged
    )


register_phase("evaluate", EvaluateConfig, _build, unit="parts")
