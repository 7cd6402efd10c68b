"""Controllers of a motor's speed that are tuned in its own world: PI, and LQR with an integral."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from scipy.optimize import minimize
from tensordict import TensorDict
from torch import Tensor

from phihp_torchrl import Task
from phihp_torchrl.baselines import LQI
from tracking_episodes import Policy, loss, play, rms, world_of

TUNING_SEED = 0
LQR = "LQR with integral action"

Criterion = Callable[[Tensor, Tensor], float]
"""What is to be least, of speeds and references ``[steps, episodes]``."""


class PI:
    """u = kp e + ki ∫ e dt, within bounds; the integral stands still where they are reached.

    Args:
        task: the task, of which it reads speed and reference.
        kp: gain in V per rad/s.
        ki: gain of the integral in V per rad.
    """

    def __init__(self, task: Task, kp: float, ki: float) -> None:
        self.task, self.kp, self.ki = task, kp, ki

    def __call__(self, tensordict: TensorDict) -> TensorDict:
        """Act."""
        state = self.task.locate(tensordict["observation"])
        reference = self.task.outside.values(self.task.split(state)[1])["reference"]
        error = reference - state[..., :1]
        if bool(tensordict["is_init"].all()):
            self.integral = torch.zeros_like(error)
        integral = self.integral + self.task.time_step * error
        wanted = self.kp * error + self.ki * integral
        action = self.task.clip_action(wanted)
        outward = (wanted != action) & (wanted * error > 0)
        self.integral = torch.where(outward, self.integral, integral)
        return tensordict.set("action", action)


def regulator(task: Task, effort: float, integral_time: float) -> LQI:
    """The LQR with integral action of the world as it is.

    Args:
        task: the task.
        effort: weight of a full action, where the largest of a half-range of the state is 1.
        integral_time: seconds in which its integral acts.
    """
    weights = (effort / task.bounds.scale.square()).tolist()
    dynamics = world_of(task, {}).oracle()
    return LQI.from_model(task, dynamics, action_weights=weights, integral_time=integral_time)


class Tunable(NamedTuple):
    """A controller of two positive numbers.

    Args:
        make: from the task and the numbers to the controller.
        numbers: what they are called.
        starts: from where they are sought.
    """

    make: Callable[[Task, float, float], Policy]
    numbers: tuple[str, str]
    starts: tuple[tuple[float, float], ...]


TUNABLE = {
    "PI": Tunable(PI, ("kp", "ki"), ((0.5, 1.0), (2.0, 5.0))),
    LQR: Tunable(regulator, ("effort", "integral time"), ((0.1, 0.15), (0.01, 0.1))),
}
CRITERIA: dict[str, Criterion] = {"least RMS error": rms, "highest return": loss}


def tune(
    kind: Tunable, task: Task, episodes: int, criterion: Criterion, tries: int = 30
) -> dict[str, float]:
    """The numbers of a controller that are best by a criterion, in the world as it is.

    Args:
        kind: the controller.
        task: the task.
        episodes: number of episodes.
        criterion: what is to be least.
        tries: how often it is played from each start.
    """

    def cost(logs: Any) -> float:
        policy = kind.make(task, *(math.exp(x) for x in logs))
        return criterion(*play(policy, task, {}, episodes=episodes, seed=TUNING_SEED))

    options = {"method": "Nelder-Mead", "options": {"maxfev": tries}}
    tried = [minimize(cost, [math.log(x) for x in start], **options) for start in kind.starts]
    best = min(tried, key=lambda found: found.fun)
    return {name: math.exp(x) for name, x in zip(kind.numbers, best.x, strict=True)}
