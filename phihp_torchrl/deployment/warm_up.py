"""Compiling an agent's plan ahead of its first use, in another process if wanted."""

from __future__ import annotations

import logging
import pickle
import tempfile
import weakref
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from phihp_torchrl.compilation import OtherProcess
from phihp_torchrl.deployment.package import use_package, write_package
from phihp_torchrl.deployment.reading import AgentError

if TYPE_CHECKING:
    from phihp_torchrl.deployment.agent import Agent

_log = logging.getLogger(__name__)
_GIVEN, _MADE = "agent", "plan.pt2"


class WarmUp:
    """A plan that is being compiled. :meth:`Agent.warm_up` makes it.

    Args:
        agent: the agent; nothing is done for one that does not plan.
        background: whether another process compiles.
    """

    def __init__(self, agent: Agent, *, background: bool) -> None:
        self._agent = weakref.ref(agent)
        self._process: OtherProcess | None = None
        self._taken = True  # nothing is under way
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
        if self._process is None or not self.compiled:
            return None
        return self._process.place / _MADE

    @property
    def ready(self) -> bool:
        """Whether nothing is under way: the plan is compiled, or cannot be."""
        return self._taken or self._process is None or self._process.ended

    def wait(self, seconds: float | None = None) -> bool:
        """Wait for the compiler and let the agent take the plan; returns :attr:`compiled`.

        Raises:
            TimeoutError: if it has not finished after so many seconds; it goes on.
        """
        if self._process is not None and not self._taken:
            try:
                self._process.wait(seconds)
            except TimeoutError as error:
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
        if process is not None and not self._taken and agent is not None:
            try:
                if process.failure:
                    raise AgentError(process.failure)
                use_package(agent, process.place / _MADE)
                self.compiled = True
            except (AgentError, RuntimeError, OSError) as error:
                _log.warning("The plan could not be compiled, and stays eager: %s", error)
        self._taken = True
        if not self.compiled:
            self._process = None
        return True

    def _start(self, agent: Agent) -> None:
        try:
            given = pickle.dumps(agent)
            place = tempfile.TemporaryDirectory(prefix="phihp-warm-up-")
            Path(place.name, _GIVEN).write_bytes(given)
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
        threads = str(torch.get_num_threads())
        self._process = OtherProcess(f"{__name__}:compile_plan", [threads], place)
        self._taken = False


def compile_plan(place: str, threads: str) -> None:
    """Compile the plan of a pickled agent: what the other process does."""
    torch.set_num_threads(int(threads))
    agent = pickle.loads(Path(place, _GIVEN).read_bytes())
    write_package(agent, Path(place, _MADE))
