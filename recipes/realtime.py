"""Run an agent against the clock and count the deadlines that it misses.

    python recipes/realtime.py results/agents/pendulum-swingup --rates 50 200 --seconds 30

The world moves on by a period at each tick, whether or not the agent has an action. The plan is
compiled, unless --eager.
"""

from __future__ import annotations

import argparse
import sys

import torch
from tensordict import TensorDict

from phihp_torchrl.deployment import AgentError, load_agent, run_realtime
from phihp_torchrl.evaluation import EVALUATION_SEED, markdown_table


def main() -> None:
    """Run at each rate, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agent", help="directory of a saved agent")
    parser.add_argument("--rates", nargs="+", type=float, default=[50.0, 200.0], help="in Hz")
    parser.add_argument("--seconds", type=float, default=30.0, help="at each rate")
    parser.add_argument("--eager", action="store_true", help="do not compile the plan")
    parser.add_argument("--actor", action="store_true", help="the actor alone, no plan")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    try:
        agent = load_agent(
            arguments.agent, planner=not arguments.actor, compile=not arguments.eager
        )
    except AgentError as error:
        sys.exit(f"error: {error}")
    for _ in range(10):  # compiles
        agent(TensorDict(observation=agent.task.observe(agent.task.reset.sample([]))))
    rows = []
    for rate in arguments.rates:
        report = run_realtime(
            agent, agent.task, rate=rate, seconds=arguments.seconds, seed=EVALUATION_SEED
        )
        rows.append([f"{value:.4g}" for value in report.summary().values()])
    header = ["Hz", "actions", "p50 ms", "p99 ms", "p99.9 ms", "missed", "mean reward"]
    print(markdown_table(header, rows))


if __name__ == "__main__":
    main()
