"""Play a trained agent: returns, latency, a picture and a GIF.

python recipes/evaluate.py agent=results/agents/acrobot episodes=50
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue

from phihp_torchrl.deployment import Agent, AgentError, load_agent
from phihp_torchrl.evaluation import evaluate, evaluation_seed, markdown_table, measure_latency
from phihp_torchrl.ranges import check_count, check_not_negative
from phihp_torchrl.trainers import ConfigError, from_mapping, import_plugins, show_episode

_ROWS = ("return_mean", "return_std", "return_min", "return_max", "length_mean", "latency_ms_mean",
         "latency_ms_p50", "latency_ms_p90", "latency_ms_p99")  # fmt: skip


@dataclass(frozen=True)
class Config:
    """What ``config/evaluate.yaml`` says, key by key."""

    agent: str
    episodes: int = 50
    planner: bool | str = "both"
    seed: int = 0
    latency_actions: int = 1000
    video: bool = True
    out_dir: str | None = None
    plugins: tuple[str, ...] = ()
    threads: int = 1
    compile: bool = False

    def __post_init__(self) -> None:
        if self.planner not in (True, False, "both"):
            raise ValueError(f"planner: expected true, false or both, got {self.planner!r}.")
        check_count(self, "episodes", "threads")
        check_not_negative(self, "seed", "latency_actions")


@hydra.main(version_base="1.3", config_path="config", config_name="evaluate")
def main(composed: DictConfig) -> None:
    """Load, play, print and write."""
    try:
        config = from_mapping(Config, OmegaConf.to_container(composed, throw_on_missing=True))
        import_plugins(config.plugins)
        agents = load(config)
    except MissingMandatoryValue:
        sys.exit("error: agent: expected the directory of a saved agent, agent=DIR.")
    except (ConfigError, AgentError) as error:
        sys.exit(f"error: {error}")
    torch.set_num_threads(config.threads)
    torch.set_flush_denormal(True)
    results = {name: play(agent, config) for name, agent in agents.items()}
    rows = [row for row in _ROWS if all(row in result for result in results.values())]
    header = [next(iter(agents.values())).task.name, *results]
    print(markdown_table(header, [[r, *(f"{x[r]:.3f}" for x in results.values())] for r in rows]))
    directory = Path(config.out_dir or config.agent)
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "evaluation.json").write_text(json.dumps(results, indent=2) + "\n")
    shown = next(iter(agents.values()))
    for path in show_episode(shown, directory, video=config.video, seed=config.seed):
        print(f"wrote {path}")


def load(config: Config) -> dict[str, Agent]:
    """The agents to compare, by name: with its planner, its actor alone, or what it has of both."""
    both = config.planner == "both"
    agents = {}
    if config.planner is not False:
        agent = load_agent(config.agent, planner=True, compile=config.compile)
        if agent.planner is not None:
            agents["planner"] = agent
        elif not both:
            raise AgentError(f"{config.agent}: expected an agent that plans, for planner=true.")
        if both and agent.actor is not None:
            agents["actor"] = agent.actor_alone()
    else:
        agents["actor"] = load_agent(config.agent, planner=False)
    return agents


def play(agent: Agent, config: Config) -> dict[str, object]:
    """Returns and latency of one agent."""
    seed = evaluation_seed(config.seed)
    played = evaluate(agent, agent.task, episodes=config.episodes, seed=seed)
    result: dict[str, object] = {**played.summary(), "returns": played.returns.tolist()}
    if config.latency_actions:
        latency = measure_latency(agent, agent.task, calls=config.latency_actions, seed=seed)
        result |= latency.summary()
    return result


if __name__ == "__main__":
    main()
