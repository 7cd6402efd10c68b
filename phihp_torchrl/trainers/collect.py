"""How phase 1 acts in the real world: at random at first, then by planning in the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, GymWrapper, StepCounter, TransformedEnv

from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.planners.factory import PlannerConfig, make_planner
from phihp_torchrl.ranges import check_count, check_not_negative
from phihp_torchrl.tasks import Task

Policy = Callable[[TensorDictBase], TensorDictBase]


@dataclass(frozen=True)
class CollectConfig:
    """How the model-based controller collects data.

    Args:
        planning_horizon: actions in a plan.
        replan_every: steps of a plan to act before the next.
        num_candidates: population of the search.
        top_k: its elites.
        optim_steps: its iterations.
        noise: std of the noise on the first planned iteration's actions, in units of the action
            bounds. It fades to zero with the last.
        random_hold: steps for which a random action is held in the first iteration, so that slow
            systems move.
        exploration_reward: whether to plan for the task's exploration reward, where it has one.
    """

    planning_horizon: int = 30
    replan_every: int = 15
    num_candidates: int = 500
    top_k: int = 20
    optim_steps: int = 3
    noise: float = 0.3
    random_hold: int = 1
    exploration_reward: bool = True

    def __post_init__(self) -> None:
        check_not_negative(self, "noise")
        check_count(self, "random_hold")
        PlannerConfig(**self.plan())  # refuses what the planner would refuse after real steps

    def plan(self) -> dict[str, Any]:
        """The planner's own arguments: plain CEM, rewards not discounted."""
        return {
            "planning_horizon": self.planning_horizon,
            "optim_steps": self.optim_steps,
            "num_candidates": self.num_candidates,
            "top_k": self.top_k,
            "replan_every": self.replan_every,
            "num_policy_candidates": 0,
            "gamma": 1.0,
        }


def make_real_env(task: Task) -> EnvBase:
    """The task's gymnasium world as a TorchRL environment that counts and limits its steps."""
    world = gymnasium.make("phihp/Task-v0", task=task)
    return TransformedEnv(GymWrapper(world), StepCounter())


def random_policy(task: Task, config: CollectConfig, generator: torch.Generator) -> Policy:
    """Uniform actions, each held for ``config.random_hold`` steps."""
    high = torch.tensor(task.action_high)
    action, count = torch.zeros_like(high), 0

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        nonlocal count, action
        if count % config.random_hold == 0:
            action = high * (2.0 * torch.rand(high.shape, generator=generator) - 1.0)
        count += 1
        return tensordict.set("action", action.clone())

    return policy


def planning_policy(
    task: Task,
    dynamics: HybridDynamics,
    config: CollectConfig,
    generator: torch.Generator,
    noise: float,
) -> Policy:
    """Plain CEM in the model as it is, plus noise in units of the action bounds."""
    if config.exploration_reward and task.exploration_reward is not None:
        task = replace(task, reward=task.exploration_reward)
    model = TaskWorldModel(task, dynamics)
    planner = make_planner(model, None, None, PlannerConfig(**config.plan()), generator=generator)
    scale = noise * torch.tensor(task.action_high)

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict["step_count"].item() == 0:
            planner.reset()
        observed = TensorDict(observation=tensordict["observation"].float())
        action = planner(observed)["action"]
        action = action + scale * torch.randn(scale.shape, generator=generator)
        return tensordict.set("action", task.clip_action(action))

    return policy
