"""A control loop in real time, which measures whether an agent acts in time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.tasks import Task, find_task
from phihp_torchrl.worlds import SimulatedWorld


@dataclass(frozen=True)
class RealTimeReport:
    """The result of :func:`run_realtime`.

    Args:
        rate: ticks per second.
        milliseconds: time from a tick to its action, for each action, ``[actions]``.
        missed: ticks at which no new action was ready, because one took longer than a period.
        mean_reward: mean reward of the ticks.
    """

    rate: float
    milliseconds: torch.Tensor
    missed: int
    mean_reward: float

    def summary(self) -> dict[str, float]:
        """Return rate, quantiles, missed ticks and mean reward, as numbers for a table."""
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
    task: str | Task,
    *,
    rate: float,
    seconds: float,
    seed: int,
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> RealTimeReport:
    """Run a policy in a control loop in real time, in the simulated world of a task.

    The world moves by one period at each tick, whether or not an action is ready. If the policy
    takes longer than a period, the previous action is held at the ticks meanwhile, which count as
    missed.

    Args:
        policy: a module that reads ``"observation"`` and writes ``"action"``. If it compiles, call
            it once before.
        task: a task or the name of a registered one; its world is stepped with the period.
        rate: ticks per second.
        seconds: duration of the loop.
        seed: seed of the first state.
        clock: a function that returns the time in seconds.
        sleep: a function that waits for a number of seconds.

    Returns:
        Latencies, missed ticks and mean reward.

    Raises:
        ConfigError: for a rate or a duration that is not positive.

    Examples:
        >>> from phihp_torchrl import Agent, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> agent = Agent(get_task("pendulum"), actor=Actor(get_task("pendulum")))
        >>> now = [0.0]
        >>> def wait(seconds):
        ...     now[0] += seconds
        >>> report = run_realtime(
        ...     agent, "pendulum", rate=50.0, seconds=0.2, seed=0, clock=lambda: now[0], sleep=wait
        ... )
        >>> len(report.milliseconds), report.missed
        (10, 0)
    """
    for name, value in (("rate", rate), ("seconds", seconds)):
        if not 0 < value < math.inf:
            raise ConfigError(name, f"expected a positive number, got {value}.")
    period, ticks = 1.0 / rate, max(1, round(rate * seconds))
    task = find_task(task)
    timed = replace(task.unpriced(), time_step=period)
    world = TaskWorldModel(timed, SimulatedWorld(timed).oracle())
    state = task.sample_start([], torch.Generator().manual_seed(seed))
    action = task.bounds.center
    milliseconds, missed, total, tick = [], 0, 0.0, 0
    start = clock()
    while tick < ticks:
        due = start + tick * period
        if (early := due - clock()) > 0:
            sleep(early)
        data = TensorDict(observation=world.observe(state), is_init=torch.tensor([tick == 0]))
        new_action = policy(data)["action"]
        took = clock() - due
        milliseconds.append(1e3 * took)
        # Whole periods since this tick, in which the world has moved on.
        late = min(int(took / period), ticks - tick - 1)
        missed += late
        for held in [action] * late + [new_action]:
            state, reward, _ = world.transition(state, held)
            total += float(reward)
        action, tick = new_action, tick + late + 1
    times = torch.tensor(milliseconds, dtype=torch.float64)
    return RealTimeReport(rate, times, missed, total / ticks)
