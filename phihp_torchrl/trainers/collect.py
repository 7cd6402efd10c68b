"""The policies of phase 1 in the real world: random at first, then planning in the model."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from tensordict import TensorDict, TensorDictBase

from phihp_torchrl.config import (
    ConfigError,
    Steps,
    check_fields,
    check_not_negative,
    check_steps,
    resolve_seconds,
)
from phihp_torchrl.dynamics import HybridDynamics, TaskWorldModel
from phihp_torchrl.planners import CEMConfig, make_planner
from phihp_torchrl.tasks import Task
from phihp_torchrl.trainers.exploration import Exploration, ExplorationConfig

_log = logging.getLogger(__name__)

_TOO_MANY = 0.2
"""The largest share of real steps that may be left out of a collection."""

Policy = Callable[[TensorDictBase], TensorDictBase]


@dataclass(frozen=True)
class CollectConfig:
    """How phase 1 collects real data: with plain CEM in the model, after random steps.

    Args:
        planning_horizon: actions in a plan of the CEM that collects data, or their duration, such
            as "1 s".
        replan_every: number of actions of a plan that are taken before the next plan, or their
            duration.
        num_candidates: candidates in an iteration of this CEM.
        top_k: elites of this CEM.
        optim_steps: iterations of this CEM.
        noise: std of the noise on planned actions, in units of the action's half-range; it falls
            to zero over the iterations of collecting and fitting.
        random_hold: steps for which a random action is held in the first iteration, or their
            duration, so that slow systems move.
        exploration_reward: whether to plan for the task's exploration reward, if it has one.
        exploration: how far and how fast actions may go, and where an episode ends to protect a
            plant.

    Raises:
        ConfigError: for a value out of range; the message names the field.

    Examples:
        >>> CollectConfig(planning_horizon=10, replan_every=5).planner().num_policy_candidates
        0
    """

    planning_horizon: Steps = 30
    replan_every: Steps = 15
    num_candidates: int = 500
    top_k: int = 20
    optim_steps: int = 3
    noise: float = 0.3
    random_hold: Steps = 1
    exploration_reward: bool = True
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)

    def __post_init__(self) -> None:
        check_fields(self)
        check_not_negative(self, "noise")
        check_steps(self, "random_hold")
        if self.random_hold != 1 and self.exploration.coloured:
            raise ConfigError(
                "random_hold",
                "expected 1 with exploration.bandwidth or exploration.colour, which set how slow "
                f"random actions are, got {self.random_hold}.",
            )
        self.planner()  # refuses what the planner would refuse after real steps

    def planner(self) -> CEMConfig:
        """Return the settings of the planner: CEM without actor and Q, rewards not discounted."""
        return CEMConfig(
            planning_horizon=self.planning_horizon,
            optim_steps=self.optim_steps,
            num_candidates=self.num_candidates,
            top_k=self.top_k,
            replan_every=self.replan_every,
            num_policy_candidates=0,
            gamma=1.0,
        )


def random_policy(
    task: Task,
    config: CollectConfig,
    generator: torch.Generator,
    exploration: Exploration | None = None,
) -> Policy:
    """Make a policy of random actions in bounds, within the limits of ``config.exploration``.

    They are uniform and held for ``config.random_hold`` steps each, or follow a coloured signal.

    Args:
        task: the task.
        config: the settings.
        generator: source of randomness.
        exploration: the limits; by default those of ``config``.
    """
    config = resolve_seconds(config, task.time_step)
    bounds = task.bounds
    explore = exploration or Exploration(task, config.exploration)
    signal = explore.signal(generator) if explore.config.coloured else None
    unit, count = bounds.center, 0

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        nonlocal count, unit
        if signal is not None:
            unit = signal(tensordict)
        elif count % config.random_hold == 0:
            unit = 2.0 * torch.rand(unit.shape, generator=generator) - 1.0
        count += 1
        limited = explore.config.limits
        action = explore.around(tensordict, unit) if limited else bounds.from_unit(unit)
        return tensordict.set("action", action)

    return policy


def steady(task: Task, policy: Policy) -> Policy:
    """Make a policy that repeats its last action while the observation is not finite."""
    last = task.bounds.center

    def guarded(tensordict: TensorDictBase) -> TensorDictBase:
        nonlocal last
        if not tensordict["observation"].isfinite().all():
            return tensordict.set("action", last.clone())
        tensordict = policy(tensordict)
        last = tensordict["action"].detach()
        return tensordict

    return guarded


def within_rate(task: Task, policy: Policy) -> Policy:
    """Make a policy whose actions are the commands that the world gets: in bounds and rate."""
    if task.action_rate_limit is None:
        return policy

    def limited(tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = policy(tensordict)
        action = tensordict["action"]
        _, registers = task.split(task.locate(tensordict["observation"].to(action.dtype)))
        return tensordict.set("action", task.command(registers, action))

    return limited


def drop_unusable(data: TensorDict) -> tuple[TensorDict, int, ConfigError | None]:
    """Leave out real transitions of which a number is missing or infinite, and warn.

    Args:
        data: transitions ``[N]`` in order, with ``"done"`` under ``"next"``.

    Returns:
        The other transitions, in which one before a gap is ``"done"``; how many were left out; and
        the error to raise, once the others are safe, if these are more than a fifth.
    """
    keys = ("observation", "action", ("next", "observation"), ("next", "reward"))
    usable = torch.stack([data[key].isfinite().all(-1) for key in keys]).all(0)
    dropped = int((~usable).sum())
    if not dropped:
        return data, 0, None
    bad = [str(key) for key in keys if not data[key].isfinite().all()]
    refusal = None
    if dropped > _TOO_MANY * len(data):
        first = int((~usable).nonzero()[0])
        refusal = ConfigError(
            "world",
            f"{dropped} of {len(data)} real steps have missing or infinite numbers in {bad}, more "
            f"than {_TOO_MANY:.0%}, the first at step {first}; look at the sensor or the "
            "environment. The other steps are kept, and a resumed run goes on with them.",
        )
    _log.warning(
        "%d of %d real steps are left out: missing or infinite numbers in %s.",
        dropped,
        len(data),
        bad,
    )
    done = data["next", "done"].clone()
    done[:-1] |= ~usable[1:, None]
    data = data.clone(recurse=False)
    data["next"] = data["next"].clone(recurse=False).set("done", done)
    return data[usable], dropped, refusal


def planning_policy(
    task: Task,
    dynamics: HybridDynamics,
    config: CollectConfig,
    generator: torch.Generator,
    noise: float,
    exploration: Exploration | None = None,
) -> Policy:
    """Make a policy that plans by CEM in the model, within the limits of ``config.exploration``.

    Args:
        task: the task.
        dynamics: the model.
        config: the settings.
        generator: source of randomness.
        noise: std of the noise on planned actions, in units of the action's half-range.
        exploration: the limits; by default those of ``config``.
    """
    explore = exploration or Exploration(task, config.exploration)
    signal = explore.signal(generator, std=1.0) if explore.config.coloured else None
    aim = explore.planning_task() if explore.config.limits else task
    if config.exploration_reward and task.exploration_reward is not None:
        aim = replace(aim, reward=task.exploration_reward, exploration_reward=task.reward)
    model = TaskWorldModel(aim, dynamics)
    planner = make_planner(model, None, None, config.planner(), generator=generator)
    scale = noise * task.bounds.scale

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict["step_count"].item() == 0:
            planner.reset()
        observation = tensordict["observation"].float()
        if task.register_count:  # whose units are half-ranges, and the aim may have others
            observation = aim.observe(task.locate(observation))
        action = planner(TensorDict(observation=observation))["action"]
        if signal is None:
            action = action + scale * torch.randn(scale.shape, generator=generator)
        else:
            action = action + scale * signal(tensordict)
        return tensordict.set("action", explore.limit(tensordict, task.clip_action(action)))

    return policy
