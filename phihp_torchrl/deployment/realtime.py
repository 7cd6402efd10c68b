"""A control loop against the clock: does an agent act in time?"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from phihp_torchrl.evaluation.seeds import EVALUATION_SEED
from phihp_torchrl.tasks import Task


@dataclass(frozen=True)
class RealTimeReport:
    """How a control loop kept time.

    Args:
        rate: ticks per second.
        milliseconds: from each tick to its action, ``[acted]``.
        missed: ticks at which no new action was ready, because one took longer than a period.
        mean_reward: mean reward of a tick in the world.
    """

    rate: float
    milliseconds: torch.Tensor
    missed: int
    mean_reward: float

    def summary(self) -> dict[str, float]:
        """Numbers for a table."""
        times = self.milliseconds
        return {
            "rate": self.rate,
            "actions": float(len(times)),
            "p50_ms": times.quantile(0.5).item(),
            "p99_ms": times.quantile(0.99).item(),
            "p99_9_ms": times.quantile(0.999).item(),
            "missed": float(self.missed),
            "mean_reward": self.mean_reward,
        }


@torch.no_grad()
def run_realtime(
    policy: TensorDictModuleBase,
    task: Task,
    *,
    rate: float,
    seconds: float,
    seed: int = EVALUATION_SEED,
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> RealTimeReport:
    """Act at each tick of a clock while the task's world goes on.

    The world moves by one period at each tick, whatever the policy does. An action that takes
    longer than a period is late: the ticks meanwhile hold the action before, and count as missed.

    Args:
        policy: reads ``"observation"``, writes ``"action"``; call it before, if it compiles.
        task: its world, stepped with the clock's period.
        rate: ticks per second.
        seconds: how long.
        seed: seed of the start.
        clock: what time it is, in seconds.
        sleep: waits for so many seconds.

    Raises:
        ValueError: for a rate or a time that is not positive.
    """
    for name, value in (("rate", rate), ("seconds", seconds)):
        if not 0 < value < math.inf:
            raise ValueError(f"{name}: expected a positive number, got {value}.")
    period, ticks = 1.0 / rate, max(1, round(rate * seconds))
    world = replace(task, time_step=period)
    state = task.reset.sample([], generator=torch.Generator().manual_seed(seed))
    action = torch.zeros(task.system.action_dim)
    milliseconds, missed, total, tick = [], 0, 0.0, 0
    start = clock()
    while tick < ticks:
        due = start + tick * period
        if (early := due - clock()) > 0:
            sleep(early)
        data = TensorDict(
            observation=world.system.observe(state), is_init=torch.tensor([tick == 0])
        )
        new_action = policy(data)["action"]
        took = clock() - due
        milliseconds.append(1e3 * took)
        # Whole periods that have gone by since this tick: the world did not wait.
        late = min(int(took / period), ticks - tick - 1)
        missed += late
        for held in [action] * late + [new_action]:
            next_state = world.step(state, held)
            total += float(world.reward(state, held, next_state))
            state = next_state
        action, tick = new_action, tick + late + 1
    times = torch.tensor(milliseconds, dtype=torch.float64)
    return RealTimeReport(rate, times, missed, total / ticks)
