"""How return and time of an action depend on the planner's horizon, replanning and candidates.

    python benchmarks/paper/sensitivity.py agent=results/agents/acrobot
    python benchmarks/paper/sensitivity.py -m agent=results/agents/acrobot,results/agents/cartpole

Evaluates one trained agent with one setting changed at a time, and writes
results/sensitivity/<task>-seed<seed>.json, from where ``make_report.py`` makes the figure.
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

from phihp_torchrl.deployment import Agent, AgentError, load_agent
from phihp_torchrl.evaluation import evaluate, measure_latency
from phihp_torchrl.planners.factory import PlannerConfig
from phihp_torchrl.ranges import check_count
from phihp_torchrl.trainers import ConfigError, from_mapping, import_plugins
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
    latency_actions: int = 100
    out: str = "results/sensitivity"
    plugins: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_count(self, "episodes", "latency_actions")


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
            raise ConfigError(f"agent: expected one that plans, {config.agent} does not.")
        settings = list(changes(config, agent.planner_config))
    except MissingMandatoryValue:
        sys.exit("error: agent: expected the directory of a saved agent, agent=DIR.")
    except (ConfigError, AgentError, ValueError) as error:
        sys.exit(f"error: {error}")
    seed = int(agent.metadata.get("seed", 0))
    path = Path(config.out) / f"{agent.task.name}-seed{seed}.json"
    trials = []
    for name, value, planner in settings:
        trials.append(play(agent, seed, name, value, planner, config))
        write_trials(path, trials)
        print(f"{name}={value}: return {trials[-1].return_mean:.1f}, "
              f"{trials[-1].milliseconds:.2f} ms", flush=True)  # fmt: skip
    print(f"wrote {path}")


def changes(config: Config, own: PlannerConfig) -> Iterator[tuple[str, int, PlannerConfig]]:
    """Each setting, its value, and the agent's planner with that one changed."""
    actors, random = own.num_policy_candidates, own.num_candidates - own.num_policy_candidates
    for value in config.planning_horizon:
        every = min(own.replan_every, value)
        changed = replace(own, planning_horizon=value, replan_every=every)
        yield "planning_horizon", value, changed
    for value in config.replan_every:
        if value <= own.planning_horizon:  # no plan can be acted beyond its end
            yield "replan_every", value, replace(own, replan_every=value)
    for value in config.num_policy_candidates:
        yield "num_policy_candidates", value, candidates(own, value, random)
    for value in config.num_random_candidates:
        yield "num_random_candidates", value, candidates(own, actors, value)


def candidates(own: PlannerConfig, actors: int, random: int) -> PlannerConfig:
    """A planner with other candidates; what they leave no room for is given up."""
    elites = min(own.top_k, actors + random)
    return replace(
        own,
        num_policy_candidates=actors,
        num_candidates=actors + random,
        top_k=elites,
        num_kept_elites=min(own.num_kept_elites, elites),
        warm_start=own.warm_start and random > 0,  # random candidates start from the last plan
    )


def play(
    agent: Agent, seed: int, name: str, value: int, planner: PlannerConfig, config: Config
) -> Trial:
    """Return and time of the agent with that planner, from the same starts each time."""
    changed = Agent(
        agent.task,
        dynamics=agent.dynamics,
        actor=agent.actor,
        qvalue=agent.qvalue,
        planner_config=planner,
    )
    played = evaluate(changed, agent.task, episodes=config.episodes)
    latency = measure_latency(changed, agent.task, calls=config.latency_actions)
    # With replanning every few steps most actions cost nothing: the mean is what a step costs.
    return Trial(
        agent.task.name, seed, name, value, played.mean, played.std, config.episodes, latency.mean
    )


if __name__ == "__main__":
    main()
