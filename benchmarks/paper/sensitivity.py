"""How return and time of an action depend on the planner's horizon, replanning and candidates.

    python benchmarks/paper/sensitivity.py agent=results/agents/acrobot
    python benchmarks/paper/sensitivity.py -m agent=results/agents/acrobot,results/agents/cartpole

Evaluates one trained agent, of any kind, with one setting of its planner changed at a time, and
writes results/sensitivity/<task>-seed<seed>.json, from where ``make_report.py`` makes the figure.
``config/sensitivity.yaml`` has every key.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue

from phihp_torchrl.config import ConfigError, check_count, from_mapping
from phihp_torchrl.deployment import Agent, AgentError, load_agent
from phihp_torchrl.evaluation import evaluate, measure_latency
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.planners import CEMConfig, SearchConfig
from phihp_torchrl.trainers import import_plugins
from phihp_torchrl.worlds import World, make_world
from report import Trial, write_trials


@dataclass(frozen=True)
class Config:
    """What ``config/sensitivity.yaml`` says, key by key."""

    agent: str
    planning_horizon: tuple[int, ...] = ()
    replan_every: tuple[int, ...] = ()
    num_policy_candidates: tuple[int, ...] = ()
    num_random_candidates: tuple[int, ...] = ()
    episodes: int = 20
    first_seed: int = 500_000
    latency_actions: int = 100
    out: str = "results/sensitivity"
    plugins: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_count(self, "episodes", "latency_actions")
        check_count(self, "first_seed", least=0)
        least = {"planning_horizon": 1, "replan_every": 1, "num_policy_candidates": 0,
                 "num_random_candidates": 0}  # fmt: skip
        for name, low in least.items():
            for i, value in enumerate(getattr(self, name)):
                if value < low:
                    raise ConfigError(f"{name}[{i}]", f"expected at least {low}, got {value}.")


@hydra.main(version_base="1.3", config_path="config", config_name="sensitivity")
def main(composed: DictConfig) -> None:
    """Load, change, play and write."""
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    try:
        mapping: Any = OmegaConf.to_container(composed, throw_on_missing=True)
        config = from_mapping(Config, mapping)
        import_plugins(config.plugins)
        agent = load_agent(config.agent)
        if agent.planner_config is None:
            raise ConfigError("agent", f"expected one that plans, {config.agent} does not.")
        settings = list(changes(config, agent.planner_config))
        world = make_world(agent.task, trained_in(agent))
    except MissingMandatoryValue:
        sys.exit("error: agent: expected the directory of a saved agent, agent=DIR.")
    except (ConfigError, AgentError) as error:
        sys.exit(f"error: {error}")
    seed = int(agent.metadata.get("seed", 0))
    path = Path(config.out) / f"{agent.task.name}-seed{seed}.json"
    trials = []
    for name, value, planner in settings:
        trials.append(play(agent, world, seed, name, value, planner, config))
        write_trials(path, trials)
        print(f"{name}={value}: return {trials[-1].return_mean:.1f}, "
              f"{trials[-1].milliseconds:.2f} ms", flush=True)  # fmt: skip
    print(f"wrote {path}")


def changes(config: Config, own: SearchConfig) -> Iterator[tuple[str, int, SearchConfig]]:
    """Each setting, its value, and the agent's planner with that one changed.

    A value that the kind of planner cannot have, such as a plan acted beyond its end or MPPI
    without random candidates, is left out.
    """
    actors, random = own.num_policy_candidates, own.num_candidates - own.num_policy_candidates
    replanned = getattr(own, "replan_every", None)  # MPPI replans at every step
    for value in config.planning_horizon:
        every = {} if replanned is None else {"replan_every": min(replanned, value)}
        yield from changed("planning_horizon", value, own, planning_horizon=value, **every)
    for value in config.replan_every if replanned is not None else ():
        yield from changed("replan_every", value, own, replan_every=value)
    for value in config.num_policy_candidates:
        yield from changed("num_policy_candidates", value, own, **candidates(own, value, random))
    for value in config.num_random_candidates:
        yield from changed("num_random_candidates", value, own, **candidates(own, actors, value))


def changed(
    name: str, value: int, own: SearchConfig, **settings: Any
) -> Iterator[tuple[str, int, SearchConfig]]:
    """The setting, its value and the planner with these settings, if it can have them."""
    try:
        yield name, value, replace(own, **settings)
    except ConfigError as error:
        print(f"{name}={value}: left out: {error}", flush=True)


def candidates(own: SearchConfig, actors: int, random: int) -> dict[str, Any]:
    """Settings of a planner with other candidates; what they leave no room for is given up."""
    elites = min(own.top_k, actors + random)
    settings = {
        "num_policy_candidates": actors,
        "num_candidates": actors + random,
        "top_k": elites,
    }
    if isinstance(own, CEMConfig):
        settings["num_kept_elites"] = min(own.num_kept_elites, elites)
        # Random candidates start from the last plan.
        settings["warm_start"] = own.warm_start and random > 0
    return settings


def trained_in(agent: Agent) -> Any:
    """The world that the agent was trained in, where it says so."""
    return (agent.metadata.get("config") or {}).get("world") or "simulated"


def play(
    agent: Agent,
    world: World,
    seed: int,
    name: str,
    value: int,
    planner: SearchConfig,
    config: Config,
) -> Trial:
    """Return and time of the agent with that planner, from the same starts each time."""
    changed = agent.with_planner(planner)
    played = evaluate(
        changed, agent.task, episodes=config.episodes, seed=config.first_seed, world=world
    )
    latency = measure_latency(changed, agent.task, calls=config.latency_actions)
    # With replanning every few steps most actions cost nothing: the mean is what a step costs.
    return Trial(
        agent.task.name,
        seed,
        name,
        value,
        played.mean,
        played.std,
        config.episodes,
        latency.mean,
        config.first_seed,
        origin_text(describe_origin(seed)),
    )


if __name__ == "__main__":
    main()
