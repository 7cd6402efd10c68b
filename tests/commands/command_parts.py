"""Words of the smallest runs, and files that users would write."""

from __future__ import annotations

from pathlib import Path

from cluster_check import TINY

SMALL = (
    *TINY,
    "progress=false",
    "policy.refit.interval=0",
    "model.real_steps=60",
    "model.steps_per_iteration=30",
    "policy.updates=8",
)
"""A run of PhIHP through all of its phases."""

FAST = (*SMALL, "evaluate.episodes=1", "evaluate.video=false", "evaluate.latency_actions=0")
"""The same without what takes time to show."""

BRIEF = (
    "progress=false",
    "evaluate.episodes=2",
    "evaluate.latency_actions=3",
    "evaluate.baselines=none",
    "evaluate.video=false",
)
"""A run that ends as soon as it has learned."""

EVALUATE = ("evaluate", "agent=run/agent", "episodes=2", "latency_actions=3", "video=false",
            "baselines=none")  # fmt: skip
"""An evaluation of its agent."""

RIG = """
from phihp_torchrl.worlds import SimulatedWorld

def make_env(task="pendulum"):
    return SimulatedWorld(task).make_env()
"""
"""A module with an environment: to the run it is any robot."""

PLUGIN = '''
from dataclasses import dataclass, fields, replace
from typing import ClassVar

from phihp_torchrl import get_task, register_method, register_phase, register_planner
from phihp_torchrl import register_task, register_world
from phihp_torchrl.config import Method
from phihp_torchrl.planners import CEMConfig, CEMPlanner
from phihp_torchrl.worlds import EnvWorld, SimulatedWorld

register_task(replace(get_task("pendulum"), name="my-pendulum", max_steps=20))


@dataclass(frozen=True)
class PatientConfig(CEMConfig):
    """CEM that waits.

    Args:
        patience: for how long.
    """

    kind: ClassVar[str] = "patient"
    patience: float = 1.0


def patient(env, config, **options):
    plain = {f.name: getattr(config, f.name) for f in fields(CEMConfig)}
    return CEMPlanner.from_config(env, CEMConfig(**plain), **options)


register_planner("patient", PatientConfig, patient, about="waits")


@dataclass(frozen=True)
class RigConfig:
    """A rig.

    Args:
        number: which one.
    """

    kind: ClassVar[str] = "rig"
    number: int = 1


class RigWorld(EnvWorld):
    kind = "rig"

    def __init__(self, task, config):
        super().__init__(task, SimulatedWorld(task).make_env, label=f"rig {config.number}")
        self.config = config


register_world("rig", RigConfig, RigWorld, about="one of our rigs")


@dataclass(frozen=True)
class RestConfig:
    """A rest.

    Args:
        naps: how many.
    """

    naps: int = 1


class Rest:
    def __init__(self, context):
        self.naps, self.taken = context.settings.naps, 0

    @property
    def done(self):
        return self.taken >= self.naps

    @property
    def progress(self):
        return self.taken, self.naps

    def advance(self):
        self.taken += 1
        return {"rest/taken": float(self.taken)}

    def state_dict(self):
        return {"taken": self.taken}

    def load_state_dict(self, state):
        self.taken = state["taken"]


register_phase("rest", RestConfig, Rest, unit="naps")
register_method(
    "rested",
    Method(
        "Rested",
        "PhIHP after a rest",
        ("model", "rest", "policy", "evaluate"),
        changes={"policy": {"decay": 0.25}},
    ),
)
'''
"""One file that registers a task, a planner, a world, a phase and a method."""


def metrics_column(path: Path, column: str) -> list[str]:
    """A column of a run's ``metrics.csv``."""
    header, *rows = (path / "metrics.csv").read_text().splitlines()
    position = header.split(",").index(column)
    return [row.split(",")[position] for row in rows]
