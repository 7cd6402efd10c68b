"""The most memory that a run of the default preset takes."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest

LIMIT = 1.5e9
# What a run allocates does not depend on how long it learns: the replay is there from the start.
SHORT = ["policy.updates=1000", "evaluate.latency_actions=20", "evaluate.video=false"]


@pytest.mark.timeout(1800)  # a whole run
def test_peak_memory(benchmark, report_memory, tmp_path):
    command = [
        sys.executable,
        "-m",
        "phihp_torchrl",
        "train",
        "task=pendulum-swingup",
        "progress=false",
    ]
    command += [*SHORT, f"run_dir={tmp_path / 'run'}"]
    benchmark.pedantic(lambda: subprocess.run(command, check=True), rounds=1)
    peak = 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    note = (
        "Peak resident memory of `phihp train task=pendulum-swingup`, compilation included, "
        f"with `{' '.join(SHORT)}`, which change nothing of what is kept in memory."
    )
    report_memory("Memory of a default run", peak, note)
    assert peak < LIMIT
