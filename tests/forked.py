"""Processes of their own that run scripts: what takes seconds to import is imported once for all.

For what only a process can show: that a kill loses nothing, and that a signal ends it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

SERVER = """
import json, os, sys
sys.path[:0] = [{tests!r}, {root!r}]
import phihp_torchrl.commands
import trainers.run_parts

for line in iter(sys.stdin.readline, ""):
    if child := os.fork():
        print("ended by", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
    else:
        print(os.getpid(), flush=True)
        exec(json.loads(line), {{"__name__": "__main__"}})
        sys.exit()  # as any program ends, with all that is done then
"""


class Forks:
    """Starts scripts one after the other, each in a process that nothing else has run in."""

    def __init__(self) -> None:
        tests = Path(__file__).parent
        script = SERVER.format(tests=str(tests), root=str(tests.parent))
        self.server = subprocess.Popen(
            [sys.executable, "-c", script],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def start(self, script: str) -> int:
        """Start a script; the number of its process."""
        assert self.server.stdin is not None
        self.server.stdin.write(json.dumps(script) + "\n")
        self.server.stdin.flush()
        return int(self.line())

    def line(self) -> str:
        """The next line that the script prints."""
        assert self.server.stdout is not None
        return self.server.stdout.readline().rstrip("\n")

    def wait(self) -> int:
        """How the script ended: its exit code, or less than zero the signal that killed it."""
        return self.end()[1]

    def end(self) -> tuple[list[str], int]:
        """What else the script prints, by lines, and how it ends."""
        lines: list[str] = []
        while not (line := self.line()).startswith("ended by "):
            assert self.server.poll() is None
            lines.append(line)
        return lines, int(line.split()[-1])

    def close(self) -> None:
        self.server.communicate()
