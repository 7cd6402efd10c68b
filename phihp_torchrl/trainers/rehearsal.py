"""The outputs of a run in small, tried before the first real step: agent, plan, figure."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from phihp_torchrl.agents import Actor, TD3Config, TwinQ
from phihp_torchrl.config import ConfigError, get_method, resolve_seconds
from phihp_torchrl.deployment import Agent, load_agent, save_agent
from phihp_torchrl.evaluation import Episode, episode_figure
from phihp_torchrl.trainers.model_config import ModelConfig, make_dynamics
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.worlds import World


def rehearse(config: RunConfig, world: World) -> None:
    """Try what a run does at its end with untrained networks, and leave nothing behind.

    An agent of the run's sizes is saved and loaded, acts once by its planner, and a figure of two
    steps is drawn. Random states stay as they are.

    Args:
        config: settings of the run.
        world: its world.

    Raises:
        ConfigError: for the first of these that fails; the message says which, and why.
    """
    agent_of = get_method(config.method).acting
    if "evaluate" not in config.phases_to_do or agent_of == "own_planner":
        return
    with (
        torch.random.fork_rng(devices=[]),
        tempfile.TemporaryDirectory(prefix="phihp-") as place,
        torch.no_grad(),
    ):
        doing, key = "made", "settings"
        try:
            agent = _untrained(config, world)
            doing, key = "saved", "task"
            save_agent(agent, place)
            doing = "loaded"
            agent = load_agent(place, task=world.task)
            doing, key = "asked for an action", "planner"
            observation = world.task.observe(world.task.sample_start([]))
            start = torch.ones(1, dtype=torch.bool)
            agent(TensorDict(observation=observation, is_init=start))
            doing, key = "shown in a figure", "task"
            _draw(world, Path(place))
        except ConfigError:
            raise
        # Anything may fail here, and would after hours of training; the message says what.
        except Exception as error:
            raise ConfigError(
                key,
                f"before any real step an untrained agent was to be {doing}, which failed: "
                f"{type(error).__name__}: {error}",
            ) from error


def _untrained(config: RunConfig, world: World) -> Agent:
    """An agent of the run's sizes."""
    task = world.task
    parts: dict[str, Any] = {}
    model, policy = config.sections.get("model"), config.sections.get("policy")
    if isinstance(model, ModelConfig):
        parts["dynamics"] = make_dynamics(world, model, torch.Generator().manual_seed(0))
    found = (policy.td3 if isinstance(policy, PolicyConfig) else None, config.sections.get("td3"))
    for td3 in found:
        if isinstance(td3, TD3Config):
            resolved = resolve_seconds(td3, task.time_step)
            parts["actor"] = Actor(task, resolved.actor_hidden_sizes)
            parts["qvalue"] = TwinQ(task, resolved.critic_hidden_sizes)
    return Agent(task, **parts, planner_config=config.planner)


def _draw(world: World, place: Path) -> None:
    """Draw a figure of two steps."""
    task = world.task
    physical, _ = task.split(task.sample_start([3]))
    actions = np.zeros((2, task.action_dim))
    no_frames = np.zeros((0, 0, 0, 3), dtype=np.uint8)
    episode = Episode(task, physical.double().numpy(), actions, np.zeros(2), False, no_frames, 1)
    episode_figure(episode).savefig(place / "episode.png", dpi=20)
