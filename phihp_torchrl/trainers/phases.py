"""The three phases behind one interface, and how each is built on those before."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from phihp_torchrl.deployment import Agent, save_agent
from phihp_torchrl.evaluation import TaskResult, evaluate, measure_latency
from phihp_torchrl.tasks import get_task
from phihp_torchrl.trainers.config import to_mapping
from phihp_torchrl.trainers.model import ModelTrainer
from phihp_torchrl.trainers.policy import PolicyTrainer
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.trainers.run_directory import RunDirectory, write_atomically
from phihp_torchrl.trainers.show import show_episode


class Phase(Protocol):
    """What a run asks of a phase."""

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
    """Phase 3: save the agent, let it act with its planner and by its actor alone, and show it.

    Args:
        agent: the agent.
        config: the run's configuration.
        directory: where agent, pictures and ``evaluation.json`` go.
    """

    def __init__(self, agent: Agent, config: RunConfig, directory: RunDirectory) -> None:
        self.agent = agent
        self.config = config
        self.directory = directory
        self.results: dict[str, dict[str, Any]] = {}
        self.new_files: list[NewFile] = []
        self._steps = (("planner", self.agent), ("actor", self.agent.actor_alone()))
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
        """Evaluate the planner, then the actor; then save and show the agent."""
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
            "samples": self.config.model.real_steps,
            "config": _public(to_mapping(self.config)),
            "returns": self.results,
        }
        save_agent(self.agent, self.directory.agent, metadata=metadata)
        write_atomically(self.directory.evaluation, json.dumps(self.results, indent=2) + "\n")
        label = f"{self.config.task}-{self.config.preset}-seed{self.config.seed}"
        self.new_files.append(NewFile(label, self.directory.agent))

    def _show(self) -> None:
        video = self.config.evaluate.video
        for path in show_episode(self.agent, self.directory.path, video=video):
            self.new_files.append(NewFile(f"evaluate/{path.stem}{path.suffix}", path))


def make_phase(
    name: str, config: RunConfig, before: Mapping[str, Any], directory: RunDirectory
) -> Phase:
    """Build a phase.

    Args:
        name: ``"model"``, ``"policy"`` or ``"evaluate"``.
        config: the run's configuration.
        before: the phases before it, done.
        directory: the run's directory.
    """
    task = get_task(config.task)
    if name == "model":
        return ModelTrainer(task, config.model, seed=config.seed)
    model: ModelTrainer = before["model"]
    if name == "policy":
        return PolicyTrainer(
            task,
            model.dynamics,
            config.policy,
            seed=config.seed,
            data_states=model.states(),
            compile=config.compile,
        )
    policy: PolicyTrainer = before["policy"]
    agent = Agent(
        task,
        dynamics=model.dynamics,
        actor=policy.best_actor(),
        qvalue=policy.best_qvalue(),
        planner_config=config.planner,
        compile=config.compile,
    )
    return EvaluatePhase(agent, config, directory)


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
    return TaskResult(config["task"], config["model"]["real_steps"], **means)
