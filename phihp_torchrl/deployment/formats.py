"""The format of an agent's JSON file: its task, and the upgrade from older versions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Task

AGENT_FILE = "agent.json"
SAVING = ".saving-"
"""Begin of the names of what is being written beside an agent."""

FORMAT = "phihp_torchrl agent"
FORMAT_VERSION = 2

# What a planner of version 1 did where its file says nothing: later settings that change nothing.
_PLANNER_OF_VERSION_1 = MappingProxyType({"tail_dtype": "float32", "actor_margin": 0.0})

# What a prior is called since.
_PRIORS_OF_VERSION_1 = MappingProxyType({"learned": "learned", "world": "plant", None: None})


@dataclass(frozen=True)
class TaskSignature:
    """The task that an agent was trained for, as far as its weights depend on it.

    Args:
        name: by which :func:`~phihp_torchrl.get_task` knows it.
        state_names: components of the state.
        action_names: components of the action.
        constants: names of the prior's constants.
        action_low: lower bounds of the action.
        action_high: upper bounds of the action.
        time_step: seconds.
    """

    name: str
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    constants: tuple[str, ...]
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    time_step: float

    @classmethod
    def of(cls, task: Task) -> TaskSignature:
        """The signature of a task."""
        return cls(
            name=task.name,
            state_names=tuple(task.system.state_names),
            action_names=tuple(task.system.action_names),
            constants=tuple(task.system.constants),
            action_low=tuple(task.action_low or ()),
            action_high=tuple(task.action_high),
            time_step=task.time_step,
        )


def upgrade(content: Mapping[str, Any]) -> dict[str, Any]:
    """Convert an agent's JSON of version 1 to version 2; version 2 is returned unchanged.

    Version 1 told TD-MPC by its key ``told`` and named no kinds, wrote the sizes of the networks
    beside them, and knew symmetric bounds alone.

    Raises:
        KeyError: for a key that version 1 must have.
        ConfigError: for a prior that there was not.
        TypeError: for a value of another form.
    """
    if content.get("format_version") != 1:
        return dict(content)
    task = dict(content["task"])
    task.setdefault("action_low", [-high for high in task["action_high"]])
    shared = {key: value for key, value in content.items() if key not in _KEYS_OF_VERSION_1}
    shared |= {"format_version": FORMAT_VERSION, "task": task}
    planner = content["planner"]
    if "told" in content:
        kinds = {"kind": "td-mpc", "networks": content["told"]}
        return {
            **shared,
            **kinds,
            "planner": None if planner is None else {"kind": "mppi", **planner},
        }
    upgraded: dict[str, Any] = {**shared, "kind": "phihp"}
    if (dynamics := content["dynamics"]) is not None:
        if dynamics["prior"] not in _PRIORS_OF_VERSION_1:
            raise ConfigError(
                "dynamics.prior",
                f"expected one of {list(_PRIORS_OF_VERSION_1)}, got {dynamics['prior']!r}.",
            )
        prior = _PRIORS_OF_VERSION_1[dynamics["prior"]]
        upgraded["dynamics"] = {
            "prior": None if prior is None else {"kind": prior},
            "residual": dynamics["residual"],
            "integrator": {"name": dynamics["integrator"]},
        }
    for part, key, kind in (
        ("actor", "actor_hidden_sizes", "mlp_actor"),
        ("qvalue", "critic_hidden_sizes", "twin_q"),
    ):
        if content[key] is not None:
            upgraded[part] = {"kind": kind, "hidden_sizes": content[key]}
    if planner is not None:
        planner = {"kind": "cem", **_PLANNER_OF_VERSION_1, **planner}
    return {**upgraded, "planner": planner}


_KEYS_OF_VERSION_1 = (
    "task",
    "dynamics",
    "told",
    "actor_hidden_sizes",
    "critic_hidden_sizes",
    "planner",
)

BOUNDS_OF_VERSION_1 = "action_high"
"""A tensor that version 1 kept among the weights of each network; it is the task's."""
