"""Folders of strangers: does anything that they name get executed, read or written?

    python benchmarks/robustness/strangers.py

The hostile runs and agents are those of the tests, which are run. Writes
results/robustness/strangers.json.
"""

from __future__ import annotations

import re
import subprocess
import sys

from found import write_part

HOSTILE = ("tests/trainers/test_hostile.py", "tests/deployment/test_saving.py")


def main() -> None:
    """Run the tests, and write how many kinds there were and how many had their way."""
    words = ["-p", "no:cacheprovider", "-k", "executed", *HOSTILE]
    done = subprocess.run([sys.executable, "-m", "pytest", *words], capture_output=True, text=True)
    counts = {word: int(n) for n, word in re.findall(r"(\d+) (passed|failed)", done.stdout)}
    passed, failed = counts.get("passed", 0), counts.get("failed", 0)
    if done.returncode not in (0, 1) or not passed + failed:  # 1 is that of tests that failed
        sys.exit(f"error: expected tests that run, got:\n{done.stdout[-2000:]}{done.stderr}")
    record = {"kinds": passed + failed, "executed": failed}
    write_part("strangers", record)
    print(record)


if __name__ == "__main__":
    main()
