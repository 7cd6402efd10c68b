"""The package of its plan that a run makes, so that its agent plans by native code once loaded."""

from __future__ import annotations

import logging
from pathlib import Path

from phihp_torchrl.deployment import Agent, place_package
from phihp_torchrl.trainers.context import Context
from phihp_torchrl.trainers.spare import has_idle_core, is_importable

_log = logging.getLogger(__name__)

# Seconds of training that earn a package, which takes another core half a minute.
_EARNS = 60.0
# Seconds that the end of a run waits for a package.
_PATIENCE = 300.0


class Packaging:
    """The plan of an agent on its way into a package, which another process compiles.

    Args:
        agent: the agent; it plans by the package once that is taken.
    """

    def __init__(self, agent: Agent) -> None:
        self._work = agent.warm_up(background=True)

    def take(self, place: Path) -> bool:
        """Wait for the package, and put it beside the agent that is saved in a directory.

        Args:
            place: the directory.

        Returns:
            Whether there is a package; where there is none a warning says why.
        """
        try:
            self._work.wait(_PATIENCE)
            if (package := self._work.package) is None:
                return False
            place_package(package, place)
        except (OSError, TimeoutError) as error:
            _log.warning("The agent has no package of its plan: %s", error)
            return False
        return True


def packages_plan(context: Context, agent: Agent) -> bool:
    """Whether the plan of an agent is packaged: as the settings say, or where it costs nobody much.

    That is on the CPU after a minute of training, where the plan is not compiled anyway, a core is
    to spare, and no rig waits beside it. Unlike what is compiled in a run, no result depends on it.

    Args:
        context: the arguments of the last phase.
        agent: the agent that it evaluates and saves.
    """
    asked = context.settings.packaged
    if agent.planner is None or asked != "auto":
        return agent.planner is not None and asked
    seconds = sum(context.directory.read_metadata().get("seconds", {}).values())
    on_cpu = all(tensor.device.type == "cpu" for tensor in agent.parameters())
    if seconds < _EARNS or context.compile or not on_cpu or not context.world.copies:
        return False
    config = context.config
    return has_idle_core(config.threads, begun=True) and is_importable(config, context.task)
