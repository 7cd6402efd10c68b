"""``phihp export``: an agent's plan as an AOTInductor package and as an ONNX model, both checked.

Each file takes an observation and standard normal noise and returns an action. It is compared with
the eager planner on states all over the task, and timed beside it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phihp_torchrl.commands.words import run_command
from phihp_torchrl.config import ConfigError, check_count, check_positive

_FORMATS = ("aoti", "onnx")


@dataclass(frozen=True)
class ExportConfig:
    """Which agent to export, and how to check the files.

    Args:
        agent: directory of a saved agent.
        out: directory of the files.
        formats: aoti (C++ and Python), onnx (needs the extra onnx), or both.
        states: number of states on which exported and eager actions are compared.
        tolerance: largest difference of actions that counts as equal, in units of the action's
            half-range.
    """

    agent: str
    out: str = "outputs/export"
    formats: tuple[str, ...] = _FORMATS
    states: int = 1000
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        if unknown := [name for name in self.formats if name not in _FORMATS]:
            raise ConfigError("formats", f"expected some of {list(_FORMATS)}, got {unknown}.")
        check_count(self, "states")
        check_positive(self, "tolerance")


def main(words: Sequence[str]) -> None:
    """Export as the words say; a word alone is the agent's directory."""
    words = [word if "=" in word or word.startswith("-") else f"agent={word}" for word in words]
    run_command(ExportConfig, words, "phihp export agent=DIR [setting=value ...]", export)


def export(config: ExportConfig) -> None:
    """Write the files, check them, time them, and print a table.

    Raises:
        ConfigError: for an agent that cannot be loaded or exported.
    """
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

    writers = {"aoti": (export_aoti, "plan.pt2"), "onnx": (export_onnx, "plan.onnx")}
    torch.set_num_threads(1)
    torch.manual_seed(0)
    try:
        agent = load_agent(config.agent)
    except AgentError as error:
        raise ConfigError("agent", str(error)) from error
    module, task = PlanModule(agent), agent.task
    states = (task.coverage or task.reset).sample([config.states])
    observations, noise = task.observe(states), module.example()[1]
    place = Path(config.out)
    place.mkdir(parents=True, exist_ok=True)
    eager = _milliseconds(module, observations, noise)
    p50, p99 = eager.quantile(0.5), eager.quantile(0.99)
    rows = [["eager", "–", "–", f"{p50:.2f}", f"{p99:.2f}", "1.00"]]
    failed = False
    for name in config.formats:
        write, file = writers[name]
        try:
            act = write(module, place / file)
        except Exception as error:  # an operator that a format lacks may show in any way
            reason = (str(error).splitlines() or [""])[0]
            print(f"{name}: not written: {type(error).__name__}: {reason}")  # noqa: T201
            continue
        differences = largest_differences(act, module, observations)
        off = differences > config.tolerance * task.bounds.scale.min()
        failed |= off.float().mean().item() > 0.01
        times = _milliseconds(act, observations, noise)
        rows.append(
            [
                f"{name}: {place / file}",
                f"{differences.median():.1e}",
                f"{int(off.sum())} of {len(off)}",
                f"{times.quantile(0.5):.2f}",
                f"{times.quantile(0.99):.2f}",
                f"{times.quantile(0.5) / p50:.2f}",
            ]
        )
    header = ["plan", "median difference", "off", "p50 ms", "p99 ms", "p50 to eager"]
    print(markdown_table(header, rows))  # noqa: T201 (a console command)
    if failed:
        sys.exit("error: more than a hundredth of the exported actions differ from the eager ones.")


def _milliseconds(act: Callable[..., Any], observations: Any, noise: Any) -> Any:
    """Time of each call, ``[N]``."""
    import torch

    times = []
    with torch.no_grad():
        for observation in observations:
            start = time.perf_counter()
            act(observation, noise)
            times.append(1e3 * (time.perf_counter() - start))
    return torch.tensor(times)
