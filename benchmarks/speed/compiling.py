"""What compiling costs and saves, by which ``compile: auto`` decides whether a run earns it.

    python benchmarks/speed/compiling.py

Writes ``phihp_torchrl/trainers/compiling.json``: for a round of updates of TD3 and a chunk of
imagined steps, the seconds of CPU that compiling takes with an empty cache, and the milliseconds
that a call then takes less. Eager and compiled code take turns, by the task's default preset. For a
step of a model alone, with Runge-Kutta and two substeps, there are its operations, the seconds that
compiling takes, and the milliseconds of a call for as many rows as a plan has, both ways.
"""

from __future__ import annotations

import json
import os
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

TASK, ROUNDS = "pendulum-swingup", 30
STEP_TASK, STEP_ROWS = "cartpole-swingup", 192
FILE = Path(__file__).parents[2] / "phihp_torchrl" / "trainers" / "compiling.json"


def main() -> None:
    """Measure with an empty cache, and write the file."""
    with tempfile.TemporaryDirectory(prefix="phihp-compiling-") as place:
        # One process compiles, so that its time is counted; both are read when torch is loaded.
        os.environ |= {"TORCHINDUCTOR_CACHE_DIR": place, "TORCHINDUCTOR_COMPILE_THREADS": "1"}
        found = measure()
    from phihp_torchrl.origin import describe_origin, machine_text

    about = {"task": TASK, "rounds": ROUNDS, "machine": machine_text(describe_origin(0))}
    FILE.write_text(json.dumps({"from": about, **found}, indent=1) + "\n")


def measure() -> dict[str, Any]:
    """Seconds to compile, and milliseconds saved a call, by function."""
    import torch

    from phihp_torchrl import HybridDynamics, get_task, load_config
    from phihp_torchrl.trainers import PolicyTrainer, read_run_config

    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    config, task = read_run_config(load_config(TASK)), get_task(TASK)
    policy = config.section("policy")
    dynamics = HybridDynamics.hybrid(task)
    calls: dict[str, list[Callable[[], Any]]] = {}
    for compiled in (False, True):
        trainer = PolicyTrainer(task, dynamics, policy, seed=0, compile=compiled)
        for name, call in functions(trainer).items():
            calls.setdefault(name, []).append(call)
    seconds, saved = {}, {}
    for name, (eager, fast) in calls.items():
        with torch.no_grad():
            start = cpu()
            fast()
            seconds[name] = round(cpu() - start, 1)
            times: tuple[list[float], list[float]] = ([], [])
            for _ in range(ROUNDS):
                for call, of in zip((eager, fast), times, strict=True):
                    start = time.thread_time()
                    call()
                    of.append(1e3 * (time.thread_time() - start))
        saved[name] = round(median(times[0]) - median(times[1]), 3)
        print(name, seconds[name], *(f"{median(of):.3f}" for of in times), flush=True)
    return {
        "seconds": seconds,
        "milliseconds": saved,
        "chunk_steps": policy.chunk_steps,
        "step": step_of_a_model(),
    }


def step_of_a_model() -> dict[str, Any]:
    """What a compiled step of a dear model costs and saves."""
    import torch

    from phihp_torchrl import HybridDynamics, get_task
    from phihp_torchrl.dynamics import PreparedModel
    from phihp_torchrl.integrators import RK4

    task = get_task(STEP_TASK)
    dynamics = HybridDynamics.hybrid(task, integrator=RK4(substeps=2))
    state, action = task.coverage.sample([STEP_ROWS]), torch.zeros(STEP_ROWS, task.action_dim)
    eager = PreparedModel(task, dynamics, state)
    dynamics.compile_step()
    with torch.no_grad():
        start = cpu()
        dynamics.compiled_step(state, action)
        seconds = cpu() - start
        fast = PreparedModel(task, dynamics, state)
        times: tuple[list[float], list[float]] = ([], [])
        for _ in range(10 * ROUNDS):
            for model, of in zip((eager, fast), times, strict=True):
                start = time.thread_time()
                model.advance(state, action)
                of.append(1e3 * (time.thread_time() - start))
    found = {"operations": eager.operations, "seconds": round(seconds, 1)}
    found |= {"eager": round(median(times[0]), 3), "compiled": round(median(times[1]), 3)}
    print("step", found, flush=True)
    return found


def functions(trainer: Any) -> dict[str, Callable[[], Any]]:
    """A call of each function: a round of updates, a chunk of steps."""
    import torch

    learner, config = trainer.learner, trainer.config
    with torch.no_grad():
        # Enough for a batch, without a call of what is to be compiled.
        while len(learner.replay) < config.random_steps:
            states = trainer.start_states.sample([config.random_steps], learner.generator)
            action = torch.zeros(len(states), trainer.task.action_dim)
            step = trainer.world_model.transition(states, action)
            learner.replay.extend(_batch(states, action, step))
    return {
        "update": lambda: learner._learn(config.batch_size, 1.0),
        "chunk": lambda: learner._imagine_chunk(),
    }


def _batch(states: Any, action: Any, step: Any) -> Any:
    from phihp_torchrl.imagination import Batch

    following, reward, terminated = step
    return Batch(states, action, reward, following, terminated)


def cpu() -> float:
    """Seconds of CPU of this process and of the compilers that it started."""
    ours, theirs = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return ours.ru_utime + ours.ru_stime + theirs.ru_utime + theirs.ru_stime


if __name__ == "__main__":
    main()
