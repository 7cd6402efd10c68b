"""What a GPU gains: imagined steps, TD3 updates and plans per second against the CPU's one thread.

    python benchmarks/speed/gpu.py --minutes 8

Runs the tests marked ``cuda`` first, then times each hot path on the devices in turn, eagerly and
compiled, from the smallest batch to the largest, and writes results/gpu/gpu.json after each row and
README.md at the end. It needs no virtual environment: the package's folder and what it imports on
``PYTHONPATH`` are enough. Where there is no GPU the CPU is timed alone, and the results say so.
Rows for which no time is left are named as not run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch
from tensordict import TensorDict

from phihp_torchrl import Agent, load_agent
from phihp_torchrl.agents import TD3Config, TD3Update, act, make_td3_loss
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.imagination import Batch, Rollouts, Worlds, draw_noise
from phihp_torchrl.origin import describe_origin, origin_text

AGENT = "results/agents/pendulum-swingup"
RESULTS = Path("results/gpu")
CHUNK = 4  # steps of all worlds in a chunk, as in training
SECONDS = 1.0  # of timing for a row, at least three calls
# From this batch on the CPU is bound by its arithmetic: a compiled row would tell nothing new.
CPU_COMPILED_BELOW = {"imagine": 1000, "update": 1000, "plan": 10}
BATCHES = {"imagine": (64, 1024, 16384), "update": (128, 1024, 8192), "plan": (1, 16, 256, 4096)}
UNITS = {"imagine": "imagined steps", "update": "critic updates", "plan": "plans"}

Call = Callable[[], Any]


@dataclass(frozen=True)
class Row:
    """A hot path at one batch size, on one device."""

    path: str
    batch: int
    device: str
    compiled: bool
    milliseconds: float | None = None
    per_second: float | None = None
    first_call_seconds: float | None = None
    calls: int = 0
    note: str = ""


def imagines(agent: Agent, batch: int, device: str, compiled: bool) -> tuple[Call, int]:
    """A chunk of ``batch`` imagined worlds."""
    task, model = agent.task, TaskWorldModel(agent.task, agent.dynamics)
    rollouts = Rollouts(model, act, task.max_steps, device=device, compile=compiled)
    weights = [p.detach() for p in agent.actor.module.mlp.parameters()]
    starts = task.coverage.sample([CHUNK, batch])
    noise = draw_noise(starts, task.bounds, std=0.1, random_fraction=0.1).to(device)
    worlds = Worlds(task.coverage.sample([batch]), torch.zeros(batch, dtype=torch.int64)).to(device)
    return lambda: rollouts.chunk(weights, worlds, noise), CHUNK * batch


def updates(agent: Agent, batch: int, device: str, compiled: bool) -> tuple[Call, int]:
    """Two updates of the critics and one of the actor, on ``batch`` transitions each."""
    config, task = TD3Config(), agent.task
    model = TaskWorldModel(task, agent.dynamics)
    update = TD3Update(make_td3_loss(model, config), model, config, compile=compiled).to(device)
    rows = batch * config.policy_delay
    state = task.coverage.sample([rows]).to(device)
    action = task.bounds.from_unit(2 * torch.rand(rows, task.action_dim) - 1).to(device)
    with torch.no_grad():
        next_state, reward, terminated = model.transition(state, action)
    data = Batch(state, action, reward, next_state, terminated)
    return lambda: update(data), config.policy_delay


def plans(agent: Agent, batch: int, device: str, compiled: bool) -> tuple[Call, int]:
    """A plan for each of ``batch`` observations, with the agent's own budget."""
    planner = load_agent(AGENT, device=device, compile=compiled).planner
    observation = agent.task.observe(agent.task.coverage.sample([batch])).to(device)
    is_init = torch.ones(batch, 1, dtype=torch.bool, device=device)
    data = TensorDict(observation=observation, is_init=is_init, batch_size=[batch])
    return lambda: planner(data.clone()), batch


PATHS = {"imagine": imagines, "update": updates, "plan": plans}


@torch.no_grad()
def measure(row: Row) -> Row:
    """Time a row: its first call, which compiles, and the median of the calls after it."""
    wait = torch.cuda.synchronize if row.device == "cuda" else lambda: None
    agent = load_agent(AGENT, device=row.device)
    start = time.perf_counter()
    call, work = PATHS[row.path](agent, row.batch, row.device, row.compiled)
    call()
    wait()
    first = time.perf_counter() - start
    times: list[float] = []
    while len(times) < 3 or sum(times) < SECONDS:
        start = time.perf_counter()
        call()
        wait()
        times.append(time.perf_counter() - start)
    typical = median(times)
    return Row(
        row.path,
        row.batch,
        row.device,
        row.compiled,
        milliseconds=1e3 * typical,
        per_second=work / typical,
        first_call_seconds=first,
        calls=len(times),
    )


def rows(devices: list[str]) -> Iterator[Row]:
    """All rows, eager ones first, for they say most in the least time."""
    for compiled in (False, True):
        for path, batches in BATCHES.items():
            for batch in batches:
                for device in devices:
                    if compiled and device == "cpu" and batch >= CPU_COMPILED_BELOW[path]:
                        continue
                    yield Row(path, batch, device, compiled)


def run_tests(folder: Path) -> dict[str, Any]:
    """Run the tests marked ``cuda``, and keep what they printed."""
    command = [sys.executable, "-m", "pytest", "tests/test_cuda.py", "-p", "no:cacheprovider"]
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    (folder / "tests.log").write_text(done.stdout + done.stderr)
    last = done.stdout.strip().splitlines()[-1:] or ["no output"]
    return {"exit": done.returncode, "line": last[0], "seconds": time.perf_counter() - start}


def write(folder: Path, record: dict[str, Any]) -> None:
    """Write what there is so far."""
    (folder / "gpu.json").write_text(json.dumps(record, indent=2) + "\n")


def page(record: dict[str, Any]) -> str:
    """The README beside the results."""
    found = {(r["path"], r["batch"], r["device"], r["compiled"]): r for r in record["rows"]}
    devices = record["devices"]
    columns = [(d, c) for d in devices for c in (False, True)]
    text = (
        "# One GPU against one thread of the CPU\n\n"
        f"Made by `python benchmarks/speed/gpu.py` ({origin_text(record['origin'])}, torch "
        f"{record['origin']['versions']['torch']}, "
        f"{record['gpu'] or 'no GPU: the CPU alone was timed'}). Networks and planner of "
        f"`{AGENT}`. Each cell is what is done in a second, from the median of the calls of "
        "at least a second; the best of the row is bold, and a dash was not run.\n\n"
        f"Tests marked `cuda`: {record['tests']['line']}.\n"
    )
    for path, batches in BATCHES.items():
        table = []
        for batch in batches:
            values = [found.get((path, batch, *column), {}).get("per_second") for column in columns]
            best = max((v for v in values if v), default=None)
            cells = ["–" if v is None else f"{v:,.0f}" for v in values]
            table.append(
                [
                    f"{batch:,}",
                    *(f"**{c}**" if v == best else c for c, v in zip(cells, values, strict=True)),
                ]
            )
        header = ["batch", *(f"{d}, {'compiled' if c else 'eager'}" for d, c in columns)]
        text += f"\n## {UNITS[path].capitalize()} per second\n\n{markdown_table(header, table)}\n"
    missing = [r for r in record["rows"] if r["note"]]
    if missing:
        text += "\nNot run: " + "; ".join(
            f"{r['path']} of {r['batch']} on {r['device']}"
            f"{', compiled' if r['compiled'] else ''} ({r['note']})"
            for r in missing
        )
        text += ".\n"
    return text


def main() -> None:
    """Run the tests, time the paths and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=8.0, help="time for all of it")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    parser.add_argument("--commit", help="of the code, where it is run outside its repository")
    options = parser.parse_args()
    end = time.perf_counter() + 60.0 * options.minutes
    options.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    cuda = torch.cuda.is_available()
    devices = ["cpu", *(["cuda"] if cuda else [])]
    origin = describe_origin(seed=0)
    if options.commit:
        origin |= {"commit": options.commit, "dirty": False}
    record: dict[str, Any] = {
        "origin": origin,
        "gpu": torch.cuda.get_device_name() if cuda else None,
        "devices": devices,
        "tests": run_tests(options.out),
        "rows": [],
    }
    print(record["tests"]["line"], flush=True)
    # What one compilation took so far: none is begun that may not end in time.
    longest = 20.0
    for row in rows(devices):
        left = end - time.perf_counter()
        if left < (1.5 * longest if row.compiled else 5.0):
            measured = Row(row.path, row.batch, row.device, row.compiled, note="no time left")
        else:
            try:
                measured = measure(row)
                longest = max(longest, measured.first_call_seconds or 0.0)
            except RuntimeError as error:
                reason = str(error).splitlines()[0]
                measured = Row(row.path, row.batch, row.device, row.compiled, note=reason)
        print(measured, flush=True)
        record["rows"].append(asdict(measured))
        write(options.out, record)
    (options.out / "README.md").write_text(page(record))
    print(page(record))


if __name__ == "__main__":
    main()
