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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from phihp_torchrl.commands.words import run_command
from phihp_torchrl.config import ConfigError, check_count, check_fields, check_positive

_FORMATS = ("aoti", "onnx", "c")
_PARTS = ("plan", "actor")
_SUFFIXES = {"aoti": "pt2", "onnx": "onnx", "c": "c"}
_TIMED = 50
"""Calls that are timed, at most."""


@dataclass(frozen=True)
class ExportConfig:
    """Which agent to export, and how to check the files.

    Args:
        agent: directory of a saved agent.
        out: directory of the files.
        formats: some of aoti (C++ and Python), onnx (needs the extra onnx) and c (the actor alone);
            format=c, or format=[c], asks for one of them. Defaults to all for which what they need
            is installed.
        parts: plan, actor, or both; of an agent that does not plan, the actor.
        states: number of states on which exported and eager actions are compared; on the first 50
            they are timed.
        tolerance: largest difference of actions that counts as equal, in units of the action's
            half-range.
        plugins: Python files or modules to import, which register the agent's task.
    """

    agent: str
    out: str = "outputs/export"
    formats: tuple[str, ...] = ()
    parts: tuple[str, ...] = _PARTS
    states: int = 200
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
        f"formats=[{word.removeprefix('format=').strip('[]')}]"
        if word.startswith("format=")
        else word
        for word in words
    ]
    run_command(ExportConfig, words, "phihp export agent=DIR [setting=value ...]", export)


def export(config: ExportConfig) -> None:
    """Write the files, then check them, time them, and print a table.

    A file that cannot be written keeps no other from it, and is an error at the end.

    Raises:
        ConfigError: for a plugin that cannot be imported, an agent that cannot be loaded or
            exported, and formats of which no part has any.
        SystemExit: for files that could not be written, and actions that differ.
    """
    import torch

    from phihp_torchrl.deployment import (
        ActorModule,
        AgentError,
        PlanModule,
        export_aoti,
        export_c,
        export_onnx,
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
    formats = config.formats or _available()
    wanted = {part: [n for n in formats if n != "c" or part == "actor"] for part in parts}
    if not any(wanted.values()):
        raise ConfigError(
            "formats",
            f"expected some that a file of {' and '.join(parts)} may have, got "
            f"{list(formats)}; c is for the actor alone.",
        )
    modules = {
        part: PlanModule(agent) if part == "plan" else ActorModule(agent)
        for part in parts
        if wanted[part]
    }
    place = Path(config.out)
    place.mkdir(parents=True, exist_ok=True)
    names = [f"{part}.{_SUFFIXES[name]}" for part in modules for name in wanted[part]]
    minutes = ", each .pt2 of which takes a minute or more" if "aoti" in formats else ""
    _say(f"Writing {', '.join(names)} to {place}{minutes}.")
    exports: dict[str, Callable[..., Any]]
    exports = {"aoti": export_aoti, "onnx": export_onnx, "c": export_c}
    written: list[tuple[Any, dict[str, Any]]] = []
    missing = []
    for part, module in modules.items():
        files = {}
        for name in wanted[part]:
            path = place / f"{part}.{_SUFFIXES[name]}"
            try:
                files[name] = exports[name](module, path)
            except Exception as error:  # an operator that a format lacks may show in any way
                reason = (str(error).splitlines() or [""])[0]
                _say(f"{path}: not written: {type(error).__name__}: {reason}")
                missing.append(path.name)
            else:
                _say(f"{path}: written")
        if files:
            written.append((module, files))
    problems = [f"not written: {', '.join(missing)}; the lines above say why."] if missing else []
    if written:
        _say(f"Comparing with the eager actions on {config.states} states.")
        states = (agent.task.coverage or agent.task.reset).sample([config.states])
        observations = agent.task.observe(agent.task.at_rest(states))
        rows, off = _compare(written, observations, place, config.tolerance)
        header = ["what", "median difference", "off", "p50 ms", "largest ms", "p50 to eager"]
        _say(markdown_table(header, rows))
        if off:
            problems.append("more than a hundredth of the exported actions differ from the eager.")
    if problems:
        sys.exit(f"error: {' '.join(problems)}")


def _available() -> tuple[str, ...]:
    """The formats for which what they need is installed."""
    if all(map(find_spec, ("onnxruntime", "onnxscript"))):
        return _FORMATS
    _say("onnx is left out: pip install 'phihp_torchrl[onnx]' for it.")
    return tuple(name for name in _FORMATS if name != "onnx")


def _compare(
    written: Sequence[tuple[Any, Mapping[str, Any]]],
    observations: Any,
    place: Path,
    tolerance: float,
) -> tuple[list[list[str]], bool]:
    """Compare what is written with the eager modules.

    Args:
        written: each eager module, and what its export returned, by format.
        observations: observations to act on, ``[N, o]``.
        place: directory of the files.
        tolerance: largest difference that counts as equal, in units of the action's half-range.

    Returns:
        The rows of the table, and whether more than a hundredth of a file's actions differ.
    """
    from phihp_torchrl.deployment import largest_differences

    rows, failed = [], False
    for module, files in written:
        eager = _milliseconds(module, module, observations)
        p50 = eager.median()
        rows.append([f"eager {module.part}", "–", "–", f"{p50:.2f}", f"{eager.max():.2f}", "1.00"])
        for name, found in files.items():
            path = place / f"{module.part}.{_SUFFIXES[name]}"
            act = _compiled(path) if name == "c" else found
            if act is None:
                rows.append([f"c: {path}", "not compiled: no cc", "–", "–", "–", "–"])
                continue
            differences = largest_differences(act, module, observations)
            off = differences > tolerance * module.task.bounds.scale.min()
            failed |= off.float().mean().item() > 0.01
            times = _milliseconds(act, module, observations)
            rows.append(
                [
                    f"{name}: {path}",
                    f"{differences.median():.1e}",
                    f"{int(off.sum())} of {len(off)}",
                    f"{times.median():.3g}",
                    f"{times.max():.3g}",
                    f"{times.median() / p50:.2f}",
                ]
            )
    return rows, failed


def _say(line: str) -> None:
    print(line, flush=True)  # noqa: T201 (a console command, which may be piped)


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
    """Time of each of a few calls, ``[N]``; the first call of all, which prepares, is none."""
    import torch

    times = []
    with torch.no_grad():
        act(observations[0], *module.draw())
        for observation in observations[:_TIMED]:
            noise = module.draw()
            start = time.perf_counter()
            act(observation, *noise)
            times.append(1e3 * (time.perf_counter() - start))
    return torch.tensor(times)
