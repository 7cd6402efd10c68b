"""``phihp export``: an agent's plan and actor as AOTInductor packages, ONNX models, and C source.

Each file takes an observation, and for a plan standard normal noise, and returns an action. It is
compared with the eager one on states all over the task, and timed beside it.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phihp_torchrl.commands.words import run_command
from phihp_torchrl.config import ConfigError, check_count, check_fields, check_positive

_FORMATS = ("aoti", "onnx", "c")
_PARTS = ("plan", "actor")
_SUFFIXES = {"aoti": "pt2", "onnx": "onnx", "c": "c"}


@dataclass(frozen=True)
class ExportConfig:
    """Which agent to export, and how to check the files.

    Args:
        agent: directory of a saved agent.
        out: directory of the files.
        formats: some of aoti (C++ and Python), onnx (needs the extra onnx) and c (the actor alone);
            format=c asks for one of them.
        parts: plan, actor, or both; of an agent that does not plan, the actor.
        states: number of states on which exported and eager actions are compared.
        tolerance: largest difference of actions that counts as equal, in units of the action's
            half-range.
        plugins: Python files or modules to import, which register the agent's task.
    """

    agent: str
    out: str = "outputs/export"
    formats: tuple[str, ...] = _FORMATS
    parts: tuple[str, ...] = _PARTS
    states: int = 1000
    tolerance: float = 1e-3
    plugins: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)
        for key, known in (("formats", _FORMATS), ("parts", _PARTS)):
            if unknown := [name for name in getattr(self, key) if name not in known]:
                raise ConfigError(key, f"expected some of {list(known)}, got {unknown}.")
        check_count(self, "states")
        check_positive(self, "tolerance")


def main(words: Sequence[str]) -> None:
    """Export as the words say; a word alone is the agent's directory."""
    words = [word if "=" in word or word.startswith("-") else f"agent={word}" for word in words]
    words = [
        f"formats=[{word.removeprefix('format=')}]" if word.startswith("format=") else word
        for word in words
    ]
    run_command(ExportConfig, words, "phihp export agent=DIR [setting=value ...]", export)


def export(config: ExportConfig) -> None:
    """Write the files, check them, time them, and print a table.

    Raises:
        ConfigError: for a plugin that cannot be imported, and an agent that cannot be loaded or
            exported.
    """
    import torch

    from phihp_torchrl.deployment import (
        ActorModule,
        AgentError,
        PlanModule,
        export_aoti,
        export_c,
        export_onnx,
        largest_differences,
        load_agent,
    )
    from phihp_torchrl.evaluation import markdown_table
    from phihp_torchrl.trainers import import_plugins

    import_plugins(config.plugins)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    try:
        agent = load_agent(config.agent, packaged=False)
    except AgentError as error:
        raise ConfigError("agent", str(error)) from error
    parts = [part for part in config.parts if part == "actor" or agent.planner is not None]
    if not parts:
        raise ConfigError("parts", "expected 'actor' for an agent that does not plan, got 'plan'.")
    modules = [PlanModule(agent) if part == "plan" else ActorModule(agent) for part in parts]
    states = (agent.task.coverage or agent.task.reset).sample([config.states])
    observations = agent.task.observe(agent.task.at_rest(states))
    place = Path(config.out)
    place.mkdir(parents=True, exist_ok=True)
    rows, failed = [], False
    for module in modules:
        eager = _milliseconds(module, module, observations)
        p50, p99 = eager.quantile(0.5), eager.quantile(0.99)
        rows.append([f"eager {module.part}", "–", "–", f"{p50:.2f}", f"{p99:.2f}", "1.00"])
        for name in config.formats:
            if name == "c" and module.part == "plan":
                continue
            path = place / f"{module.part}.{_SUFFIXES[name]}"
            try:
                if name == "c":
                    export_c(module, path)  # type: ignore[arg-type]  # the actor's
                    act = _compiled(path)
                    if act is None:
                        rows.append([f"c: {path}", "not compiled: no cc", "–", "–", "–", "–"])
                        continue
                else:
                    act = {"aoti": export_aoti, "onnx": export_onnx}[name](module, path)
            except Exception as error:  # an operator that a format lacks may show in any way
                reason = (str(error).splitlines() or [""])[0]
                print(f"{name}: not written: {type(error).__name__}: {reason}")  # noqa: T201
                continue
            differences = largest_differences(act, module, observations)
            off = differences > config.tolerance * agent.task.bounds.scale.min()
            failed |= off.float().mean().item() > 0.01
            times = _milliseconds(act, module, observations)
            rows.append(
                [
                    f"{name}: {path}",
                    f"{differences.median():.1e}",
                    f"{int(off.sum())} of {len(off)}",
                    f"{times.quantile(0.5):.3g}",
                    f"{times.quantile(0.99):.3g}",
                    f"{times.quantile(0.5) / p50:.2f}",
                ]
            )
    header = ["what", "median difference", "off", "p50 ms", "p99 ms", "p50 to eager"]
    print(markdown_table(header, rows))  # noqa: T201 (a console command)
    if failed:
        sys.exit("error: more than a hundredth of the exported actions differ from the eager ones.")


def _compiled(source: Path) -> Callable[..., Any] | None:
    """The function in a C file, compiled for the check; ``None`` where there is no compiler."""
    import torch

    if (compiler := shutil.which("cc")) is None:
        return None
    with tempfile.TemporaryDirectory() as directory:
        library = Path(directory, "actor.so")
        words = [compiler, "-O3", "-shared", "-fPIC", str(source), "-o", str(library), "-lm"]
        subprocess.run(words, check=True)
        function = getattr(ctypes.CDLL(str(library)), f"{source.stem}_act")
    number = ctypes.POINTER(ctypes.c_float)
    count = int(source.read_text(encoding="utf-8").split("ACTION = ", 1)[1].split(" ", 1)[0])

    def act(observation: Any) -> Any:
        action = torch.empty(count, dtype=torch.float32)
        seen = observation.contiguous()
        function(*(ctypes.cast(each.data_ptr(), number) for each in (seen, action)))
        return action

    return act


def _milliseconds(act: Callable[..., Any], module: Any, observations: Any) -> Any:
    """Time of each call, ``[N]``."""
    import torch

    times = []
    with torch.no_grad():
        for observation in observations:
            noise = module.draw()
            start = time.perf_counter()
            act(observation, *noise)
            times.append(1e3 * (time.perf_counter() - start))
    return torch.tensor(times)
