"""Write an agent's planner as an AOTInductor package and as an ONNX model, and check both.

    python recipes/export.py results/agents/pendulum-swingup --out outputs/export

Each file takes an observation and standard normal noise and returns an action. It is compared with
the eager planner on states all over the task, and timed beside it. ONNX needs the extra `onnx`.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import torch

from phihp_torchrl.deployment import (
    AgentError,
    PlanModule,
    export_aoti,
    export_onnx,
    largest_differences,
    load_agent,
)
from phihp_torchrl.evaluation import markdown_table

FORMATS = {"aoti": (export_aoti, "plan.pt2"), "onnx": (export_onnx, "plan.onnx")}


def milliseconds(act, observations: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """Time of each call, ``[N]``."""
    times = []
    with torch.no_grad():
        for observation in observations:
            start = time.perf_counter()
            act(observation, noise)
            times.append(1e3 * (time.perf_counter() - start))
    return torch.tensor(times)


def main() -> None:
    """Export, check, time."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agent", help="directory of a saved agent")
    parser.add_argument("--out", type=Path, default=Path("outputs/export"))
    parser.add_argument("--formats", nargs="+", choices=list(FORMATS), default=list(FORMATS))
    parser.add_argument("--states", type=int, default=1000, help="states to compare on")
    parser.add_argument("--tolerance", type=float, default=1e-3, help="of an action's bound")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    try:
        agent = load_agent(arguments.agent)
        module = PlanModule(agent)
    except (AgentError, ValueError) as error:
        sys.exit(f"error: {error}")
    task = agent.task
    states = (task.coverage or task.reset).sample([arguments.states])
    observations, noise = task.system.observe(states), module.example()[1]
    arguments.out.mkdir(parents=True, exist_ok=True)
    eager = milliseconds(module, observations, noise)
    p50, p99 = eager.quantile(0.5), eager.quantile(0.99)
    rows = [["eager", "–", "–", f"{p50:.2f}", f"{p99:.2f}", "1.00"]]
    failed = False
    for name in arguments.formats:
        export, file = FORMATS[name]
        try:
            act = export(module, arguments.out / file)
        except Exception as error:  # an operator that a format lacks may show in any way
            print(f"{name}: not written: {type(error).__name__}: {str(error).splitlines()[0]}")
            continue
        differences = largest_differences(act, module, observations)
        off = differences > arguments.tolerance * min(task.action_high)
        failed |= off.float().mean().item() > 0.01
        times = milliseconds(act, observations, noise)
        rows.append(
            [
                f"{name}: {arguments.out / file}",
                f"{differences.median():.1e}",
                f"{int(off.sum())} of {len(off)}",
                f"{times.quantile(0.5):.2f}",
                f"{times.quantile(0.99):.2f}",
                f"{times.quantile(0.5) / p50:.2f}",
            ]
        )
    header = ["plan", "median difference", "off", "p50 ms", "p99 ms", "p50 to eager"]
    print(markdown_table(header, rows))
    if failed:
        sys.exit("error: more than a hundredth of the exported actions differ from the eager ones.")


if __name__ == "__main__":
    main()
