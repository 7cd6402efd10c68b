"""Printed scripts that start other processes, run as a reader runs them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.docs.blocks import ROOT

EXPECTED = {
    "collect.py": ["40 (8, 1)"],
    "collect_async.py": ["40 (8, 1)"],
    "parallel.py": ["(2, 50) False", "[False, True]"],
}

RUN = """
import multiprocessing.context as contexts, runpy, sys
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


@pytest.mark.slow
@pytest.mark.timeout(300)  # importing TorchRL takes long where many share the machine
def test_scripts_print_what_the_page_says(place):
    (place / "seeds.py").write_text(SEEDS)
    script = (place / "collect.py").read_text()  # of the other collector the page says: the same
    (place / "collect_async.py").write_text(script.replace("MultiSync", "MultiAsync"))
    paths = os.pathsep.join([str(place), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", RUN, *EXPECTED],
        cwd=place,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    printed = [line for line in done.stdout.splitlines() if line[0] in "([0123456789"]
    assert printed == [line for lines in EXPECTED.values() for line in lines]
