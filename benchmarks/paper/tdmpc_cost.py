"""What TD-MPC costs here: an update and a plan of both presets, and so a run.

python benchmarks/paper/tdmpc_cost.py
python benchmarks/paper/tdmpc_cost.py --task cartpole --repeats 20

Both presets take turns; the table has medians. CPU seconds say what a core of one's own would take,
where the machine is shared.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from statistics import median

import torch
from tensordict import TensorDict

from phihp_torchrl import get_task, load_config
from phihp_torchrl.tdmpc import TDMPCTrainConfig, TDMPCTrainer
from phihp_torchrl.trainers import read_run_config

PRESETS = ("paper", "default")


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--task", default="pendulum-swingup")
    parser.add_argument("--repeats", type=int, default=5, help="updates and plans of each preset")
    parser.add_argument("--compile", action="store_true", help="compile the losses, as runs do")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    works = {name: prepare(options.task, name, options.compile) for name in PRESETS}
    seconds: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for _ in range(options.repeats + 1):
        for name, (_, *functions) in works.items():
            for kind, function in zip(("update", "plan"), functions, strict=True):
                seconds.setdefault((name, kind), []).append(measure(function))
    print("| preset | update, ms | plan, ms | update, CPU ms | plan, CPU ms | CPU hours of a run |")
    print("|:---|---:|---:|---:|---:|---:|")
    for name, (section, *_) in works.items():
        # The first of each warms up, and compiles.
        wall, cpu = (
            [median(pair[i] for pair in seconds[name, kind][1:]) for kind in ("update", "plan")]
            for i in (0, 1)
        )
        run = section.real_steps * (section.updates_per_step * cpu[0] + cpu[1]) / 3600
        cells = " | ".join(f"{1e3 * value:.1f}" for value in (*wall, *cpu))
        print(f"| {name} | {cells} | {run:.2f} |")


def prepare(
    task_name: str, preset: str, compile: bool
) -> tuple[TDMPCTrainConfig, Callable[[], object], Callable[[], object]]:
    """A preset's settings, an update and a plan, with 2,000 random steps in replay."""
    overrides = {"tdmpc.seed_steps": 2000}
    settings = load_config(task_name, method="td-mpc", preset=preset, overrides=overrides)
    section = read_run_config(settings).section("tdmpc")
    task = get_task(task_name)
    trainer = TDMPCTrainer(task, section, seed=0, compile=compile)
    while trainer.updates_due < 1:
        trainer.advance()
    # A plan as it is in the end, with its full horizon.
    agent = trainer.agent().with_planner(section.planner.at(section.planner.schedule_steps))
    observation = TensorDict(observation=task.observe(task.reset.sample([])))
    return (
        section,
        lambda: trainer.update(trainer.replay.sample(), generator=trainer.generator),
        lambda: agent(observation.clone()),
    )


def measure(function: Callable[[], object]) -> tuple[float, float]:
    """Wall and CPU seconds of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    function()
    return time.perf_counter() - wall, time.process_time() - cpu


if __name__ == "__main__":
    main()
