"""What studies in imagination share: a policy that is trained in a fitted model, and its plans."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch

from phihp_torchrl import Agent, load_agent, load_config
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.evaluation import TARGETS
from phihp_torchrl.origin import describe_origin
from phihp_torchrl.planners import SearchConfig
from phihp_torchrl.trainers import PolicyTrainer, play, read_run_config

AGENTS = Path("results/agents")
"""Agents whose fitted models are trained in."""

Trainer = TypeVar("Trainer", bound=PolicyTrainer)


@dataclass(frozen=True)
class Trained(Generic[Trainer]):
    """A policy that was trained in the model of a task's agent, without a real step.

    Args:
        agent: the agent whose model it is.
        trainer: the trainer at its end.
        search: the planner's settings of the task.
        seed: that of everything random.
        seconds: of CPU time that it took.
    """

    agent: Agent
    trainer: Trainer
    search: SearchConfig | None
    seed: int
    seconds: float

    def plan(self, episodes: int, search: SearchConfig | None = None, **parts: Any) -> list[float]:
        """Imagined returns of plans, of the same episodes each time.

        Args:
            episodes: how many.
            search: the planner's settings, if not the task's.
            **parts: of the agent, in the place of those that were trained.
        """
        own = {
            "dynamics": self.agent.dynamics,
            "actor": self.trainer.best_actor(),
            "qvalue": self.trainer.best_qvalue(),
        }
        task = self.agent.task
        planner = Agent(task, **own | parts, planner_config=search or self.search)
        assert self.agent.dynamics is not None
        model = TaskWorldModel(task, self.agent.dynamics)
        states = task.sample_start([episodes], torch.Generator().manual_seed(self.seed))
        found: list[float] = play(planner, model, states, seed=self.seed).total.tolist()
        return found


def train(
    task: str, seed: int, settings: Sequence[str], trainer: type[Trainer]
) -> Trained[Trainer]:
    """Train actor and critics by a task's default settings, but for those that are given."""
    agent = load_agent(AGENTS / task, packaged=False)
    config = read_run_config(load_config(task, overrides=list(settings)))
    assert agent.dynamics is not None  # of an agent that was trained in it
    torch.manual_seed(seed)
    start = time.process_time()
    made = trainer(agent.task, agent.dynamics, config.section("policy"), seed=seed)
    while not made.done:
        made.advance()
    return Trained(agent, made, config.planner, seed, time.process_time() - start)


def study(
    what: str,
    results: Path,
    measure: Callable[[str, int], dict[str, Any]],
    page: Callable[[Sequence[dict[str, Any]]], str],
) -> None:
    """Measure tasks and seeds that are missing, as the command line says, and write the page.

    Args:
        what: the study, in a sentence.
        results: where a file for each task and seed goes, unless the command line says otherwise.
        measure: of a task and a seed, what the file says besides these and its origin.
        page: of what all files say, in the order of tasks and seeds, as Markdown.
    """
    parser = argparse.ArgumentParser(description=what)
    parser.add_argument("--tasks", nargs="+", choices=list(TARGETS), default=list(TARGETS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[20, 21])
    parser.add_argument("--results", type=Path, default=results)
    parser.add_argument("--only-write", action="store_true")
    options = parser.parse_args()
    options.results.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    for seed in () if options.only_write else options.seeds:
        for task in options.tasks:
            path = options.results / f"{task}-seed{seed}.json"
            if not path.is_file():
                found = {"task": task, "seed": seed, **measure(task, seed)}
                path.write_text(json.dumps(found | {"origin": describe_origin(seed)}) + "\n")
                print(path.stem, flush=True)
    runs = [json.loads(path.read_text()) for path in options.results.glob("*.json")]
    runs.sort(key=lambda run: ([*TARGETS].index(run["task"]), run["seed"]))
    (options.results / "README.md").write_text(page(runs))
