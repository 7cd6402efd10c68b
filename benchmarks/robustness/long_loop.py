"""Two hours of a control loop of 50 Hz, without waiting: does its memory grow?

    python benchmarks/robustness/long_loop.py                     # 360,000 steps
    python benchmarks/robustness/long_loop.py --steps 20000

A controller with a small compiled planner and the actor as its fallback acts in the simulated
world, in episodes of 500 steps. The resident set of the process is read every thousand steps.
Writes results/robustness/long_loop.json.
"""

from __future__ import annotations

import argparse
import gc
import os
import time
from pathlib import Path

import torch

from found import write_part
from phihp_torchrl import load_agent
from phihp_torchrl.deployment import Controller
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.planners import CEMConfig
from phihp_torchrl.worlds import SimulatedWorld

RATE, EPISODE, EVERY = 50, 500, 1_000
AGENT = Path(__file__).parents[2] / "results" / "agents" / "pendulum"
SMALL = CEMConfig(
    planning_horizon=1, optim_steps=1, num_candidates=4, top_k=2, num_policy_candidates=2
)


def main() -> None:
    """Act, and read the memory from time to time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=2 * 3600 * RATE)
    parser.add_argument("--minutes", type=float, default=600.0, help="at most so long")
    options = parser.parse_args()
    torch.set_num_threads(1)
    agent = load_agent(AGENT).with_planner(SMALL, compile=True)
    task = agent.task
    controller = Controller(agent)
    world = TaskWorldModel(task, SimulatedWorld(task).oracle())
    generator = torch.Generator().manual_seed(0)
    sizes: list[int] = []
    start, steps = time.monotonic(), 0
    with torch.inference_mode():
        while steps < options.steps and time.monotonic() - start < 60 * options.minutes:
            if steps % EPISODE == 0:
                state = task.sample_start([], generator)
                controller.reset()
            action = torch.from_numpy(controller.step(world.observe(state)))
            state, _, _ = world.transition(state, action)
            steps += 1
            if steps % EVERY == 0:
                gc.collect()
                sizes.append(resident())
    warm = max(1, len(sizes) // 10)
    mib = 2**20
    record = {
        "steps": steps,
        "hours_at_50_hz": steps / RATE / 3600,
        "seconds": round(time.monotonic() - start, 1),
        "warm_up": warm * EVERY,
        "growth_mib": (sizes[-1] - sizes[warm - 1]) / mib,
        "peak_mib": (max(sizes[warm - 1 :]) - sizes[warm - 1]) / mib,
        "resident_mib": [round(size / mib, 2) for size in sizes[:: max(1, len(sizes) // 40)]],
        "controller": controller.report().summary(),
    }
    write_part("long_loop", record)
    print(record)


def resident() -> int:
    """Bytes of the process that are in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    main()
