"""Printed scripts that start other processes, run as a reader runs them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.docs.blocks import ROOT

EXPECTED = {
    "collect.py": ["40 (8, 1)"],
    "parallel.py": ["(2, 50) False", "[False, True]"],
}


@pytest.mark.slow
@pytest.mark.timeout(300)  # each process imports TorchRL, also where many share the machine
@pytest.mark.parametrize("script", EXPECTED)
def test_a_script_prints_what_the_page_says(script, place):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, script], cwd=place, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stdout.splitlines() if line[0] in "([0123456789"] == EXPECTED[
        script
    ]
