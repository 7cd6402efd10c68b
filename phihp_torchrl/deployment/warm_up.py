"""Compiling an agent's plan ahead of its first use, in another process if wanted."""

from __future__ import annotations

import logging
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import weakref
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from phihp_torchrl.deployment.package import use_package, write_package
from phihp_torchrl.deployment.reading import AgentError

if TYPE_CHECKING:
    from phihp_torchrl.deployment.agent import Agent

_log = logging.getLogger(__name__)
_MADE = "plan.pt2"
_CHILD = "import sys; from phihp_torchrl.deployment.warm_up import work; work(*sys.argv[1:])"


class WarmUp:
    """A plan that is being compiled. :meth:`Agent.warm_up` makes it.

    Compiling in a thread holds the interpreter for most of its time, so that plans and compiler
    take turns; another process needs a core of its own, and nothing of this one.

    Args:
        agent: the agent; nothing is done for one that does not plan.
        background: whether another process compiles.
    """

    def __init__(self, agent: Agent, *, background: bool) -> None:
        self._agent = weakref.ref(agent)
        self._place: tempfile.TemporaryDirectory[str] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self.compiled = False
        """Whether the agent plans by compiled code."""
        planner = agent.planner
        if planner is None:
            return
        if reason := planner.why_not_compiled():
            _log.warning("The plan is not compiled: %s.", reason)
        elif planner.plans_ahead(agent.example()):
            self.compiled = True
        elif background:
            self._start(agent)
        else:
            planner.compile_plan(agent.example())
            self.compiled = True

    @property
    def package(self) -> Path | None:
        """The package that another process has made, if it has been taken."""
        if self._place is None or not self.compiled:
            return None
        return Path(self._place.name, _MADE)

    @property
    def ready(self) -> bool:
        """Whether nothing is under way: the plan is compiled, or cannot be."""
        return self._process is None or self._process.poll() is not None

    def wait(self, seconds: float | None = None) -> bool:
        """Wait for the compiler and let the agent take the plan; returns :attr:`compiled`.

        Raises:
            TimeoutError: if it has not finished after so many seconds; it goes on.
        """
        if self._process is not None:
            try:
                self._process.wait(seconds)
            except subprocess.TimeoutExpired as error:
                raise TimeoutError(f"warm_up: still compiling after {seconds} s.") from error
        self.take()
        return self.compiled

    def take(self) -> bool:
        """Let the agent plan by what is compiled, if it is; returns whether nothing is left to do.

        If compiling failed, a warning says why, and the agent stays eager.
        """
        if not self.ready:
            return False
        process, agent = self._process, self._agent()
        self._process = None
        if process is not None and self._place is not None and agent is not None:
            try:
                if process.returncode:
                    text = (
                        Path(self._place.name, "log")
                        .read_text(errors="replace", encoding="utf-8")
                        .strip()
                    )
                    raise AgentError((text.splitlines() or ["no reason given"])[-1])
                use_package(agent, Path(self._place.name, _MADE))
                self.compiled = True
            except (AgentError, RuntimeError, OSError) as error:
                _log.warning("The plan could not be compiled, and stays eager: %s", error)
        if not self.compiled:
            self._place = None
        return True

    def _start(self, agent: Agent) -> None:
        try:
            written = pickle.dumps(agent)
            self._place = tempfile.TemporaryDirectory(prefix="phihp-warm-up-")
            given, made = (Path(self._place.name, name) for name in ("agent", _MADE))
            given.write_bytes(written)
        except OSError as error:
            _log.warning("The plan stays eager: %s", error)
            return
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            _log.warning(
                "The plan stays eager, because another process cannot be given the agent: %s. "
                "Define functions of its task in a module, or call warm_up() in the foreground.",
                error,
            )
            return
        numbers = str(torch.get_num_threads()), str(os.getpid())
        words = [sys.executable, "-c", _CHILD, str(given), str(made), *numbers]
        paths = os.pathsep.join(path for path in sys.path if path)
        with open(Path(self._place.name, "log"), "wb") as log:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONPATH": paths},
                start_new_session=True,  # a Ctrl-C of the terminal is not for it
            )
        weakref.finalize(self, _end, self._process)


def work(given: str, made: str, threads: str, parent: str) -> None:
    """Compile the plan of a pickled agent: what the other process does."""
    watched = int(parent), Path(given).parent
    threading.Thread(target=_end_with, args=watched, daemon=True).start()
    torch.set_num_threads(int(threads))
    agent = pickle.loads(Path(given).read_bytes())
    write_package(agent, Path(made))


def _end_with(parent: int, place: Path) -> None:
    """End this process, and what it was given, when its parent has ended without a word."""
    while os.getppid() == parent:
        time.sleep(1.0)
    shutil.rmtree(place, ignore_errors=True)
    os._exit(1)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Stop a compiler whose result nobody waits for any more."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(5.0)  # it may be writing
        except subprocess.TimeoutExpired:
            process.kill()
