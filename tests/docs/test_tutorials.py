"""The tutorials run from top to bottom: files, commands and Python, with small settings."""

from __future__ import annotations

import ast
import re
import runpy
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from phihp_torchrl.commands.console import main as phihp
from phihp_torchrl.config import override_lines
from phihp_torchrl.worlds import make_world
from tests.docs.blocks import BLOCKS, SHELLS, Block
from tests.docs.conftest import TINY, as_before
from tests.docs.test_examples import run_block

TUTORIALS = [page for page in BLOCKS if page.startswith("docs/tutorials/")]
LINES = 60
"""What a user writes for a tutorial: lines of Python and YAML, and commands."""

SMALLER = {
    "train": TINY,
    "identify": {"identify.windows": 12, "identify.lag": 0, "identify.slew": 0,
                 "identify.dead_zone": 0, "identify.gain_low": 1, "identify.largest_delay": 2},
    "evaluate": {"episodes": 1, "latency_actions": 0, "video": False},
}  # fmt: skip
"""What makes a printed command short; it goes over what the page says."""


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", TUTORIALS)
def test_a_tutorial_runs_as_printed(page, place):
    needs = {"docs/tutorials/simulator.md": "dm_control"}
    if page in needs:
        pytest.importorskip(needs[page])
    with background() as started:
        for block in BLOCKS[page]:
            if block.language in SHELLS:
                for line in block.text.replace("\\\n", " ").strip().splitlines():
                    run_line(line, place, started)
            elif block.language == "python" and block.title is None:
                with as_before(place):  # a session of its own, as each command is a process
                    run_block(block, {"__name__": "printed"})
    runs = [path.parent for path in place.glob("outputs/*/run/agent/agent.json")]
    assert len(runs) == 1, "a tutorial ends with a controller"
    for report in place.glob("outputs/*/report"):
        assert (report / "identification.html").stat().st_size > 10_000


def run_line(line: str, place: Path, started: list[subprocess.Popen[bytes]]) -> None:
    """Run a line of a shell; a command of ours has small settings and leaves nothing imported."""
    program, *words = shlex.split(line)
    if program == "phihp":
        command, *words = words
        if "steps=3000" in words or "steps=1000" in words:
            words.append("steps=400")
        with as_before(place):
            phihp([command, *words, *override_lines(SMALLER[command])])
            if "aero" in sys.modules:  # a process that ends hangs up
                sys.modules["aero"].make_env().close()
    elif program == "python" and words[-1] == "&":
        words = [*words[:-1], "speed=0", "seconds=240"]
        started.append(subprocess.Popen([sys.executable, *words], cwd=place))
        wait_for(place / "aero.port")
    elif program == "python":
        with as_before(place):
            runpy.run_path(words[0], run_name="__main__")
    else:
        assert program == "pip", f"unknown program {program!r}"


@contextmanager
def background() -> Iterator[list[subprocess.Popen[bytes]]]:
    """A list of processes that have ended afterwards, whatever happens."""
    started: list[subprocess.Popen[bytes]] = []
    try:
        yield started
    finally:
        for process in started:
            process.kill()
            process.wait(timeout=10)


def wait_for(path: Path) -> None:
    """Wait until a file has something in it, for ten seconds at most."""
    end = time.monotonic() + 10.0
    while not (path.is_file() and path.read_text()):
        assert time.monotonic() < end, f"{path} does not come"
        time.sleep(0.02)


@pytest.mark.parametrize("page", TUTORIALS)
def test_a_tutorial_is_short(page):
    """Files that stand for a machine are no work of the user's; all else is."""
    own = [block for block in BLOCKS[page] if not (block.title or "").endswith("_plant.py")]
    count = sum(code_lines(block) for block in own if block.language != "text")
    assert count < LINES, f"{page}: {count} lines"


def code_lines(block: Block) -> int:
    """Lines that are not blank, no comment and no docstring; a command is one line."""
    text = block.text
    if block.language in SHELLS:
        return len(re.sub(r"\\\n|\n(?=    )", " ", text).strip().splitlines())
    if block.language == "python":
        tree = ast.parse(text)
        spoken = set()
        for node in ast.walk(tree):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and node.body:
                first = node.body[0]
                if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                    spoken |= set(range(first.lineno, (first.end_lineno or 0) + 1))
        lines = [line for n, line in enumerate(text.splitlines(), 1) if n not in spoken]
    else:
        lines = text.splitlines()
    return sum(bool(line.strip()) and not line.strip().startswith("#") for line in lines)


@pytest.fixture
def rig(place: Path) -> Iterator[Any]:
    """The rig of the tutorial, served; called with its speed."""
    with background() as started:

        def serve(speed: float) -> Any:
            words = ["aero_plant.py", f"speed={speed}", "seconds=60"]
            started.append(subprocess.Popen([sys.executable, *words], cwd=place))
            wait_for(place / "aero.port")
            import aero

            world = make_world(aero.task, aero.make_env)
            return world.make_env(), started[-1], aero

        yield serve


def test_the_rig_keeps_its_time_and_ends_an_episode_that_is_late(rig):
    env, _, _ = rig(1.0)
    now = env.reset()
    begun = time.monotonic()
    steps = env.rollout(25, lambda td: td.set("action", env.action_spec.zero() + 0.2),
                        tensordict=now, auto_reset=False)  # fmt: skip
    assert time.monotonic() - begun > 0.015 * len(steps)  # 50 a second, unless it ended early
    now = env.reset()
    time.sleep(0.2)
    late = env.step(now.set("action", env.action_spec.zero()))["next"]
    assert late["truncated"].item()
    assert late["observation"].isnan().all()
    assert env.reset()["observation"].isfinite().all()


def test_the_rig_stops_before_its_limit_switch(rig):
    env, _, aero = rig(0)
    steps = env.rollout(250, lambda td: td.set("action", env.action_spec.zero() + 1.0))
    last = steps["next"][-1]
    assert len(steps) < 250
    assert last["truncated"].item()
    assert 1.4 < last["observation"][0].item() < 1.6
    assert not aero.make_env().tell(0.0)  # it is there for whoever comes next


def test_a_rig_that_is_gone_is_an_error_and_no_hang(rig):
    env, process, _ = rig(0)
    now = env.reset()
    process.kill()
    process.wait(timeout=10)
    begun = time.monotonic()
    with pytest.raises((OSError, ValueError)):
        env.rollout(3, tensordict=now, auto_reset=False)
    assert time.monotonic() - begun < 10.0


def test_a_value_that_is_not_printed_is_not_looked_for(place):
    """The runner sees a block that fails."""
    with pytest.raises(ZeroDivisionError):
        run_block(Block("page.md", 1, "python", None, "1 / 0\n"), {})
    with pytest.raises(AssertionError, match="unknown program"):
        run_line("curl https://example.com", place, [])
