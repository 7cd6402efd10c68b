"""Measurement of the time of one action."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from phihp_torchrl.config import ConfigError
from phihp_torchrl.evaluation.seeds import EVALUATION_SEED
from phihp_torchrl.tasks import Task, find_task

DOING = "timing actions"
"""What a run says that it is doing while this is on its stack."""


@dataclass(frozen=True)
class Latency:
    """The time of an action in milliseconds, over many calls.

    Args:
        mean: mean.
        p50: median.
        p90: 90th percentile.
        p99: 99th percentile.
        p99_9: 99.9th percentile.
        calls: number of calls.
        threads: intra-op threads of torch during the calls.
    """

    mean: float
    p50: float
    p90: float
    p99: float
    p99_9: float
    calls: int
    threads: int

    def summary(self) -> dict[str, float]:
        """Return mean and quantiles as numbers for a logger or a JSON file."""
        return {f"latency_ms_{k}": v for k, v in asdict(self).items() if k.startswith(("m", "p"))}


def measure_latency(
    policy: TensorDictModuleBase,
    task: str | Task,
    *,
    calls: int = 1000,
    warmup: int = 20,
    seed: int = EVALUATION_SEED,
    device: torch.device | str | None = None,
) -> Latency:
    """Measure the time of one action, for one observation of batch size ``[]`` at a time.

    Each call gets another state of the task. Global random states are restored.

    Args:
        policy: a module that reads ``"observation"`` and writes ``"action"``.
        task: a task or the name of a registered one.
        calls: number of timed calls; the 99.9th percentile needs about a thousand.
        warmup: number of earlier calls that are not timed, in which the policy may compile.
        seed: seed of the states and of the policy's noise.
        device: device of the policy.

    Returns:
        Mean and quantiles in milliseconds.

    Raises:
        ConfigError: if ``calls`` is not positive or ``warmup`` is negative.

    Examples:
        >>> from phihp_torchrl import Agent, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> agent = Agent(get_task("pendulum"), actor=Actor(get_task("pendulum")))
        >>> latency = measure_latency(agent, "pendulum", calls=5, warmup=1)
        >>> latency.calls, 0 < latency.p50 <= latency.p99
        (5, True)
    """
    if calls < 1:
        raise ConfigError("calls", f"expected a positive number, got {calls}.")
    if warmup < 0:
        raise ConfigError("warmup", f"expected a number >= 0, got {warmup}.")
    task = find_task(task)
    generator = torch.Generator().manual_seed(seed)
    states = (task.coverage or task.reset).sample([warmup + calls], generator=generator)
    observations = task.observe(task.at_rest(states)).to(device)
    cuda = [observations.device] if observations.is_cuda else []
    milliseconds = []
    with torch.random.fork_rng(devices=cuda), torch.no_grad():
        torch.manual_seed(seed)
        for i, observation in enumerate(observations):
            is_init = torch.tensor([i == 0], device=observation.device)
            tensordict = TensorDict(observation=observation, is_init=is_init)
            start = time.perf_counter()
            policy(tensordict)
            if cuda:
                torch.cuda.synchronize(cuda[0])
            milliseconds.append(1e3 * (time.perf_counter() - start))
    times = torch.tensor(milliseconds[warmup:], dtype=torch.float64)
    return Latency(
        mean=times.mean().item(),
        p50=times.quantile(0.5).item(),
        p90=times.quantile(0.9).item(),
        p99=times.quantile(0.99).item(),
        p99_9=times.quantile(0.999).item(),
        calls=calls,
        threads=torch.get_num_threads(),
    )
