"""The recipe of a plant behind a socket: the loop answers, and missed deadlines are counted."""

from __future__ import annotations

import json
import runpy
import socket
import struct
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch

from phihp_torchrl import save_agent
from phihp_torchrl.deployment import Controller, Safety
from phihp_torchrl.deployment.socket_plant import serve

from .agent_parts import make_agent

ROOT = Path(__file__).parents[2]
RECIPE = runpy.run_path(str(ROOT / "recipes" / "socket_loop.py"))


def listen() -> socket.socket:
    line = socket.socket(type=socket.SOCK_DGRAM)
    line.bind(("127.0.0.1", 0))
    line.settimeout(20.0)
    return line


def plant(line: socket.socket, rate: float, ticks: int) -> threading.Thread:
    arguments = ("pendulum", rate, ticks, line.getsockname())
    thread = threading.Thread(target=serve, args=arguments, daemon=True)
    thread.start()
    return thread


def test_an_actor_controls_a_plant_at_50_hz():
    controller = Controller(make_agent(use_planner=False), safety=Safety(deadline=1.0))
    controller.warm_up(1)
    with listen() as line:
        thread = plant(line, 50.0, 50)
        ticks, missed = RECIPE["control"](controller, line)
        thread.join(5.0)
    controller.close()
    report = controller.report()
    assert ticks == report.steps == 50
    assert missed < 50, "no command has ever come in time"
    assert not report.reasons


def test_a_plant_without_an_answer_misses_every_tick_but_the_first():
    """The first tick comes before the first sample, so that no command can be there."""
    samples = []
    with listen() as line:
        plant(line, 200.0, 6)
        while packet := line.recv(1024):
            samples.append(packet)
    numbers = [struct.unpack("=iid3f", packet)[:2] for packet in samples]
    assert numbers == [(0, 0), (1, 1), (2, 2), (3, 3), (4, 4), (5, 5)]


@contextmanager
def threaded(name: str, rate: float, seconds: float) -> Iterator[socket.socket]:
    """The recipe's plant in a thread: a process takes long to start."""
    assert name == "pendulum"
    with listen() as line:
        thread = plant(line, rate, round(rate * seconds))
        yield line
        thread.join(5.0)


@pytest.fixture
def saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A saved agent; what scripts set for their process does not reach the tests after."""
    monkeypatch.setattr(torch, "set_flush_denormal", lambda mode: True)
    return save_agent(make_agent(), tmp_path / "agent")


OPTIONS = ("--rates", "50", "--seconds", "0.2")


def test_the_recipe_plays_by_plan_and_by_actor(
    saved: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(RECIPE["main"].__globals__, "simulated_plant", threaded)
    monkeypatch.setattr(sys, "argv", ["socket_loop.py", str(saved), *OPTIONS])
    RECIPE["main"]()
    rows = capsys.readouterr().out.strip().splitlines()[2:]
    assert [row.split(" | ")[0] for row in rows] == ["| plan", "| actor"]
    assert all("of 10 |" in row for row in rows)


@pytest.mark.slow
def test_what_measures_it_has_the_plant_in_a_process(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "realtime"
    script = ROOT / "benchmarks" / "paper" / "control_loops.py"
    words = ["--agent", str(saved), "--out", str(out), "--acting", "actor", *OPTIONS]
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "argv", [str(script), *words])
    runpy.run_path(str(script), run_name="__main__")
    (row,) = json.loads((out / "realtime.json").read_text())["rows"]
    assert (row["acting"], row["ticks"]) == ("actor", 10)
    assert "| actor | 50 | 10 |" in (out / "README.md").read_text()
