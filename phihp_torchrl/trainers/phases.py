"""Phases behind one interface, and how each is built on those before."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

from phihp_torchrl.deployment import Agent, save_agent
from phihp_torchrl.evaluation import TaskResult, evaluate, measure_latency
from phihp_torchrl.tasks import Task, get_task
from phihp_torchrl.trainers.config import ConfigError, to_mapping
from phihp_torchrl.trainers.methods import get_method
from phihp_torchrl.trainers.model import ModelTrainer
from phihp_torchrl.trainers.policy import PolicyTrainer
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.trainers.run_directory import RunDirectory, write_atomically
from phihp_torchrl.trainers.show import show_episode
from phihp_torchrl.trainers.td3 import RealTD3Trainer
from phihp_torchrl.trainers.tdmpc import TDMPCTrainer

T = TypeVar("T")


class Phase(Protocol):
    """What a run asks of a phase.

    A phase that takes real steps counts them in an attribute ``real_steps``; one that learns a part
    of the agent returns it from a method ``parts``, as an argument of
    :class:`~phihp_torchrl.deployment.Agent` by name, or the whole of it as ``agent``.
    """

    @property
    def done(self) -> bool:
        """Whether nothing is left to do."""

    @property
    def progress(self) -> tuple[int, int]:
        """How much is done, and how much there is in all, in a unit of the phase's own."""

    def advance(self) -> dict[str, float]:
        """Do the next bit of work and return its metrics."""

    def state_dict(self) -> dict[str, Any]:
        """All that the rest of the phase depends on, but for the global random states."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from there."""


class NewFile(NamedTuple):
    """A file or directory for the logger.

    Args:
        label: its name there.
        path: where it is.
    """

    label: str
    path: Path


class EvaluatePhase:
    """The last phase: let the agent act by planner and by actor, save it and show it.

    An agent may have one of the two alone.

    Args:
        agent: the agent.
        config: the run's configuration.
        directory: where agent, pictures and ``evaluation.json`` go.
        samples: real steps that the agent has cost.
    """

    def __init__(
        self, agent: Agent, config: RunConfig, directory: RunDirectory, samples: int
    ) -> None:
        self.agent = agent
        self.config = config
        self.directory = directory
        self.samples = samples
        self.results: dict[str, dict[str, Any]] = {}
        self.new_files: list[NewFile] = []
        self._steps: list[tuple[str, Agent]] = []
        if agent.planner is not None:
            self._steps.append(("planner", agent))
        if agent.actor is not None:
            self._steps.append(("actor", agent.actor_alone()))
        self._finished = False

    @property
    def progress(self) -> tuple[int, int]:
        """Evaluations done and in all, the closing one included."""
        return len(self.results) + self._finished, len(self._steps) + 1

    @property
    def done(self) -> bool:
        """Whether everything is evaluated, saved and shown."""
        return self._finished

    def advance(self) -> dict[str, float]:
        """Evaluate the planner, then the actor, as far as there are; then save and show it."""
        self.new_files = []
        if len(self.results) < len(self._steps):
            return self._evaluate(*self._steps[len(self.results)])
        self._save()
        self._show()
        self._finished = True
        return {}

    def state_dict(self) -> dict[str, Any]:
        return {"results": self.results, "finished": self._finished}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.results = dict(state["results"])
        self._finished = bool(state["finished"])

    def _evaluate(self, name: str, agent: Agent) -> dict[str, float]:
        config, task = self.config.evaluate, self.agent.task
        played = evaluate(agent, task, episodes=config.episodes)
        summary = played.summary()
        if config.latency_actions:
            summary |= measure_latency(agent, task, calls=config.latency_actions).summary()
        self.results[name] = {**summary, "returns": played.returns.tolist()}
        return {f"evaluate/{name}/{key}": value for key, value in summary.items()}

    def _save(self) -> None:
        origin = (self.directory.read_metadata().get("sessions") or [{}])[0]
        metadata = {
            "seed": self.config.seed,
            "commit": origin.get("commit"),
            "dirty": origin.get("dirty"),
            "command": origin.get("command"),
            "samples": self.samples,
            "config": _public(to_mapping(self.config)),
            "returns": self.results,
        }
        save_agent(self.agent, self.directory.agent, metadata=metadata)
        write_atomically(self.directory.evaluation, json.dumps(self.results, indent=2) + "\n")
        label = f"{self.config.task}-{self.config.label}"
        self.new_files.append(NewFile(label, self.directory.agent))

    def _show(self) -> None:
        video = self.config.evaluate.video
        for path in show_episode(self.agent, self.directory.path, video=video):
            self.new_files.append(NewFile(f"evaluate/{path.stem}{path.suffix}", path))


@dataclass(frozen=True)
class Context:
    """What a phase is built from.

    Args:
        config: the run's configuration.
        task: its task.
        before: the phases before it, done, by name.
        directory: the run's directory.
    """

    config: RunConfig
    task: Task
    before: Mapping[str, Any]
    directory: RunDirectory


class PhaseKind(NamedTuple):
    """A kind of phase.

    Args:
        build: makes the phase.
        unit: what its progress counts.
    """

    build: Callable[[Context], Phase]
    unit: str


def _make_model(context: Context) -> Phase:
    config = context.config
    return ModelTrainer(context.task, _given(config.model), seed=config.seed)


def _make_policy(context: Context) -> Phase:
    config, model = context.config, context.before["model"]
    return PolicyTrainer(
        context.task,
        model.dynamics,
        _given(config.policy),
        seed=config.seed,
        data_states=model.states(),
        compile=config.compile,
    )


def _make_td3(context: Context) -> Phase:
    config, model = context.config, context.before.get("model")
    return RealTD3Trainer(
        context.task,
        _given(config.td3),
        seed=config.seed,
        transitions=None if model is None else model.transitions(),
        compile=config.compile,
    )


def _make_tdmpc(context: Context) -> Phase:
    config = context.config
    return TDMPCTrainer(
        context.task, _given(config.tdmpc), seed=config.seed, compile=config.compile
    )


def _make_evaluate(context: Context) -> Phase:
    parts: dict[str, Any] = {}
    for phase in context.before.values():
        parts |= phase.parts()
    config, agent = context.config, parts.get("agent")
    if agent is None:
        agent = Agent(context.task, **parts, planner_config=config.planner, compile=config.compile)
    samples = real_steps(context.before)
    return EvaluatePhase(agent, config, context.directory, samples)


PHASE_KINDS = {
    "model": PhaseKind(_make_model, "steps"),
    "policy": PhaseKind(_make_policy, "updates"),
    "td3": PhaseKind(_make_td3, "steps"),
    "tdmpc": PhaseKind(_make_tdmpc, "steps"),
    "evaluate": PhaseKind(_make_evaluate, "parts"),
}
"""Phases by name; a method is a sequence of these."""


def check_phases(config: RunConfig) -> None:
    """Refuse a method with phases of an unknown kind; a plugin may have registered one.

    Raises:
        ConfigError: naming the phases.
    """
    phases = (*config.phases_before, *config.phases_to_do)
    if unknown := [name for name in phases if name not in PHASE_KINDS]:
        raise ConfigError(
            f"method: expected phases among {sorted(PHASE_KINDS)}, {config.method!r} has {unknown}."
        )


def make_phase(
    name: str, config: RunConfig, before: Mapping[str, Any], directory: RunDirectory
) -> Phase:
    """Build a phase.

    Args:
        name: one of :data:`PHASE_KINDS`.
        config: the run's configuration.
        before: the phases before it, done, by name.
        directory: the run's directory.
    """
    return PHASE_KINDS[name].build(Context(config, get_task(config.task), before, directory))


def real_steps(phases: Mapping[str, Any]) -> int:
    """Steps that these phases have taken in the real world."""
    return sum(getattr(phase, "real_steps", 0) for phase in phases.values())


def _given(section: T | None) -> T:
    """A section of the configuration that RunConfig has seen to."""
    if section is None:
        raise ValueError("expected the section of a phase that the method has, got none.")
    return section


def _public(config: dict[str, Any]) -> dict[str, Any]:
    """The configuration without what is of no interest outside the machine."""
    private = ("from", "plugins", "logger", "progress", "checkpoint_interval", "keep_checkpoints")
    return {key: value for key, value in config.items() if key not in private}


def read_result(path: Path) -> TaskResult | None:
    """What the agent of the run in ``path`` has earned; ``None`` if it was not evaluated."""
    directory = RunDirectory(path)
    if not directory.evaluation.is_file():
        return None
    results, config = json.loads(directory.evaluation.read_text()), directory.read_config()
    means = {name: (result["return_mean"],) for name, result in results.items()}
    samples = directory.read_metadata()["real_steps"]
    label = get_method(config.get("method", "phihp")).label
    return TaskResult(config["task"], samples, label=label, **means)
