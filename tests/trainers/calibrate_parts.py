"""An agent of a brief task, and its calibration by a few short episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import nn

from phihp_torchrl import Agent, HybridDynamics, get_task
from phihp_torchrl.agents import Actor
from phihp_torchrl.planners import CEMConfig, SearchConfig
from phihp_torchrl.trainers import CalibrateConfig, CalibratePhase

SMALL = CEMConfig(
    planning_horizon=3, optim_steps=1, num_candidates=32, top_k=4, num_policy_candidates=2
)
TINY = CalibrateConfig(enabled=True, episodes=3, max_episodes=6, catch=False)


def make_agent(name: str = "brief-pendulum", planner: SearchConfig = SMALL) -> Agent:
    torch.manual_seed(0)
    task = get_task(name)
    actor = Actor(task)
    return Agent(task, dynamics=HybridDynamics.hybrid(task), actor=actor, planner_config=planner)


def finished(
    agent: Agent,
    config: CalibrateConfig = TINY,
    seed: int = 0,
    path: Path | None = None,
    others: Sequence[nn.Module] = (),
) -> CalibratePhase:
    phase = CalibratePhase(agent, config, seed=seed, path=path, others=others)
    while not phase.done:
        phase.advance()
    return phase
