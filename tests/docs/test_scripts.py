"""Printed scripts that start other processes, run as a reader runs them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT

EXPECTED = {
    "collect.py": ["40 (8, 1)"],
    "parallel.py": ["(2, 50) False", "[False, True]"],
}

RUN = """
import faulthandler, multiprocessing.context as contexts, runpy, sys
faulthandler.dump_traceback_later(120, exit=True)  # where it hangs, if it does
forked = contexts._concrete_contexts["forkserver"]
forked.set_forkserver_preload(["torchrl.collectors", "phihp_torchrl.worlds", "seeds"])
contexts._concrete_contexts["spawn"] = forked
for script in sys.argv[1:]:
    runpy.run_path(script, run_name="__main__")
"""
"""One process after the other; their workers begin where TorchRL is imported already.

A worker is sent what a spawned one is, imports the script itself, and has seeds of its own.
"""
SEEDS = "import os, torch; os.register_at_fork(after_in_child=torch.seed)"


ENDING = """
    import gc
    del collector
    gc.collect()
"""
"""What the page says of the end of a script with an asynchronous collector."""

TRIES = 2
"""Of the asynchronous collector, which now and then gives no answer."""


def run(place: Path, *scripts: str) -> subprocess.CompletedProcess[str]:
    (place / "seeds.py").write_text(SEEDS)
    paths = os.pathsep.join([str(place), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", RUN, *scripts]
    return subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True)


def printed(done: subprocess.CompletedProcess[str]) -> list[str]:
    return [line for line in done.stdout.splitlines() if line[0] in "([0123456789"]


@pytest.mark.slow
@pytest.mark.timeout(300)  # importing TorchRL takes long where many share the machine
def test_scripts_print_what_the_page_says(place: Path) -> None:
    done = run(place, *EXPECTED)
    assert done.returncode == 0, done.stderr
    assert printed(done) == [line for lines in EXPECTED.values() for line in lines]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_asynchronous_collector_does_the_same(place: Path) -> None:
    script = (place / "collect.py").read_text()
    assert "MultiSyncCollector" in script
    script = script.replace("MultiSync", "MultiAsync") + ENDING
    (place / "collect_async.py").write_text(script)
    for _ in range(TRIES):
        done = run(place, "collect_async.py")
        if done.returncode == 0 or "Timeout (" not in done.stderr:
            break
    assert done.returncode == 0, done.stderr
    assert printed(done) == EXPECTED["collect.py"]
