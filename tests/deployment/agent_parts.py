"""Small agents, what they do, and files that are not as they were saved."""

from __future__ import annotations

import hashlib
import json

import pytest
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict

from phihp_torchrl import Agent, HybridDynamics, load_agent
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.deployment import AgentError
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.tasks import find_task

SMALL = CEMConfig(
    planning_horizon=3, optim_steps=2, num_candidates=16, top_k=4, num_policy_candidates=4
)


def make_agent(task="pendulum", config=SMALL, **options):
    task = find_task(task)
    parts = {
        "dynamics": HybridDynamics.hybrid(task),
        "actor": Actor(task, (8, 8)),
        "qvalue": TwinQ(task, (8, 8)),
    }
    return Agent(task, **{**parts, "planner_config": config, **options})


def observations(agent, batch):
    task = agent.task
    observation = task.observe((task.coverage or task.reset).sample(batch))
    return TensorDict(observation=observation, batch_size=batch)


def act(agent, tensordict):
    torch.manual_seed(0)
    agent.reset()
    return agent(tensordict.clone())["action"]


def edit_json(directory, change):
    path = directory / "agent.json"
    content = json.loads(path.read_text())
    content.pop("sha256", None)  # as in a file of an earlier version, which nothing seals
    change(content)
    path.write_text(json.dumps(content))


def edit_weights(directory, change):
    """A change whose checksum fits, so that the other checks have to see it."""
    path = directory / "weights.safetensors"
    weights = load_file(path)
    change(weights)
    save_file(weights, path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    edit_json(directory, lambda content: content.update(weights_sha256=digest))


def refused(directory, match, **options):
    with pytest.raises(AgentError, match=match) as error:
        load_agent(directory, **options)
    return str(error.value)
