"""``phihp evaluate``: play a trained agent; returns, latency, a picture and a GIF."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from phihp_torchrl.commands.words import run_command
from phihp_torchrl.config import ConfigError, check_choice, check_count, check_fields, check_memory

if TYPE_CHECKING:
    from phihp_torchrl.deployment import Agent
    from phihp_torchrl.worlds import World

_ROWS = ("return_mean", "return_std", "return_min", "return_max", "length_mean", "latency_ms_mean",
         "latency_ms_p50", "latency_ms_p90", "latency_ms_p99")  # fmt: skip


@dataclass(frozen=True)
class PlayConfig:
    """Which agent to play, and how.

    Args:
        agent: directory of a saved agent.
        episodes: number of real episodes.
        planner: true (plan), false (the actor alone) or both.
        seed: number of the evaluation seed, from 0.
        world: settings of the world to play in, with their kind; null for the world that the agent
            was trained in.
        latency_actions: actions whose time is measured, one at a time; 0 for none.
        baselines: controllers by hand to play beside it, built in its model; auto (the quick ones
            that apply, in a simulated world), none, or a list of their names.
        video: whether to write a GIF of an episode (needs the extra rendering).
        out_dir: directory of pictures and evaluation.json; null for that of the agent.
        plugins: Python files or modules to import, which register tasks and worlds.
        trust: whether to play in a world that is made by code which the agent's file names.
        threads: intra-op threads.
        compile: whether to compile the planner (10 to 40 s the first time).
    """

    agent: str
    episodes: int = 50
    planner: bool | str = "both"
    seed: int = 0
    world: Any = None
    latency_actions: int = 1000
    baselines: str | tuple[str, ...] = "auto"
    video: bool = True
    out_dir: str | None = None
    plugins: tuple[str, ...] = field(default=())
    trust: bool = False
    threads: int = 1
    compile: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        check_choice(self, "planner", (True, False, "both"))
        check_count(self, "episodes", "threads")
        check_count(self, "seed", "latency_actions", least=0)
        check_memory(self, "episodes")
        check_memory(self, "latency_actions", each=2)  # times of float64


def main(words: Sequence[str]) -> None:
    """Play as the words say."""
    run_command(PlayConfig, words, "phihp evaluate agent=DIR [setting=value ...]", play)


def play(config: PlayConfig) -> None:
    """Load, play, print and write.

    Raises:
        ConfigError: for an agent that cannot be loaded, or a world that is none of its task.
    """
    import torch

    from phihp_torchrl.baselines import check_names
    from phihp_torchrl.deployment import AgentError
    from phihp_torchrl.evaluation import (
        BASELINES_KEY,
        controllers_table,
        evaluation_seed,
        markdown_table,
        play_baselines,
        show_episode,
    )
    from phihp_torchrl.trainers import import_plugins, write_atomically

    import_plugins(config.plugins)
    check_names(config.baselines)
    try:
        agents = _load(config)
    except AgentError as error:
        raise ConfigError("agent", str(error)) from error
    shown = next(iter(agents.values()))
    world = _world(config, shown)
    torch.set_num_threads(config.threads)
    torch.set_flush_denormal(True)
    results = {name: _play(agent, world, config) for name, agent in agents.items()}
    rows = [row for row in _ROWS if all(row in result for result in results.values())]
    header = [f"{shown.task.name} in {world}", *results]
    table = [[row, *(f"{result[row]:.3f}" for result in results.values())] for row in rows]
    print(markdown_table(header, table))  # noqa: T201 (a console command)
    beside = play_baselines(
        shown,
        world,
        config.baselines,
        episodes=config.episodes,
        seed=evaluation_seed(config.seed),
        latency_actions=config.latency_actions,
    )
    if beside or shown.task.constraints:
        print(controllers_table("controller", {**results, **beside}))  # noqa: T201
    if beside:
        results[BASELINES_KEY] = beside
    directory = Path(config.out_dir or config.agent)
    directory.mkdir(parents=True, exist_ok=True)
    write_atomically(directory / "evaluation.json", json.dumps(results, indent=2) + "\n")
    options = {"world": world, "video": config.video, "seed": config.seed}
    for path in show_episode(shown, directory, **options):  # type: ignore[arg-type]
        print(f"wrote {path}")  # noqa: T201


def _load(config: PlayConfig) -> dict[str, Agent]:
    """The agents to compare, by name: with its planner, its actor alone, or what it has of both."""
    from phihp_torchrl.deployment import AgentError, load_agent

    if config.planner is False:
        return {"actor": load_agent(config.agent, planner=False)}
    both = config.planner == "both"
    agents = {}
    agent = load_agent(config.agent, planner=True, compile=config.compile)
    if agent.planner is not None:
        agents["planner"] = agent
    elif not both:
        raise AgentError(f"{config.agent}: expected an agent that plans, for planner=true.")
    if both and agent.actor is not None:
        agents["actor"] = agent.actor_alone()
    return agents


def _world(config: PlayConfig, agent: Agent) -> World:
    """The world that is asked for, or else the one in which the agent was trained."""
    from phihp_torchrl.trainers import named_code
    from phihp_torchrl.worlds import has_env, make_world

    trained_in = (agent.metadata.get("config") or {}).get("world")
    named = {} if config.world else named_code({"world": trained_in})
    # A module that the user names is the user's wish; what it would be called with is not.
    named = {key: name for key, name in named.items() if name not in config.plugins}
    if named and not config.trust:
        listed = ", ".join(f"{key}: {name}" for key, name in named.items())
        raise ConfigError(
            "world",
            f"the agent's file names code that would be imported and called ({listed}), and anyone "
            "may have written it. Read that code; if you trust it, name the world on the command "
            "line or say trust=true.",
        )
    world = config.world or trained_in or "simulated"
    if not has_env(world):  # before its files are read
        whose = "" if config.world else ", in which the agent was trained"
        raise ConfigError(
            "world",
            f"expected one to act in, got recordings alone{whose}. Name another one: "
            "world=simulated has the task's equations with its first guesses of the constants.",
        )
    return make_world(agent.task, world)


def _play(agent: Agent, world: World, config: PlayConfig) -> dict[str, Any]:
    """Returns and latency of one agent."""
    from phihp_torchrl.evaluation import (
        evaluate,
        evaluation_seed,
        measure_latency,
        warn_of_slow_plans,
    )

    seed = evaluation_seed(config.seed)
    played = evaluate(
        agent,
        agent.task,
        episodes=config.episodes,
        seed=seed,
        # As in the run that trained it: the same episodes for all agents, each with its own noise.
        noise_seed=seed + int(agent.metadata.get("seed") or 0),
        world=world,
    )
    result: dict[str, Any] = {**played.summary(), "returns": played.returns.tolist()}
    if config.latency_actions:
        latency = measure_latency(agent, agent.task, calls=config.latency_actions, seed=seed)
        result |= latency.summary()
        warn_of_slow_plans(agent, result["latency_ms_p50"])
    return result
