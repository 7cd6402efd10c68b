"""The registered baselines by name, and those of a task in a model."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tensordict.nn import TensorDictModuleBase
from torch import nn

from phihp_torchrl.baselines.energy import starts_low
from phihp_torchrl.baselines.energy_shaping import EnergyShaping
from phihp_torchrl.baselines.ilqr import ILQR
from phihp_torchrl.baselines.lqi import LQI
from phihp_torchrl.baselines.lqr import LQR
from phihp_torchrl.baselines.pid import PID
from phihp_torchrl.config import ConfigError, Registry
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.planners import MPPIConfig, make_planner
from phihp_torchrl.tasks import Task

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class BaselineKind:
    """A registered baseline.

    Args:
        build: ``(task, dynamics) -> controller``, which refuses by a ``ConfigError`` what it cannot
            control.
        applies: whether a task may have it, without a model.
        about: description in one line.
        slow: whether an action costs about as much as a plan, so that it is played only where it
            is named.
    """

    build: Callable[[Task, nn.Module], TensorDictModuleBase]
    applies: Callable[[Task], bool]
    about: str = ""
    slow: bool = False


BASELINES: Registry[BaselineKind] = Registry("baselines")
"""Registered baselines by name."""


def register_baseline(
    name: str,
    build: Callable[[Task, nn.Module], TensorDictModuleBase],
    *,
    applies: Callable[[Task], bool] = lambda task: True,
    about: str = "",
    slow: bool = False,
    replace: bool = False,
) -> BaselineKind:
    """Register a controller that evaluations play beside an agent.

    Args:
        name: the name, for ``baselines=[name]``.
        build: ``(task, dynamics) -> controller``: a module that reads ``"observation"``
            ``[*batch, o]`` and writes ``"action"`` ``[*batch, m]`` in physical units. It raises a
            :class:`~phihp_torchrl.ConfigError` where it cannot control the task in that model.
        applies: whether a task may have it at all; by default every task.
        about: description in one line.
        slow: whether to play it only where it is named.
        replace: whether a baseline of that name may be replaced.

    Returns:
        The registered kind.

    Raises:
        ConfigError: if the name is taken and ``replace`` is false.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> def still(task, dynamics):
        ...     act = lambda obs: 0 * obs[..., : task.action_dim]
        ...     return TensorDictModule(act, ["observation"], ["action"])
        >>> register_baseline("still", still, about="no action", slow=True).slow
        True
    """
    return BASELINES.register(name, BaselineKind(build, applies, about, slow), replace=replace)


def make_baselines(
    task: Task, dynamics: nn.Module, names: str | Sequence[str] = "auto"
) -> dict[str, TensorDictModuleBase]:
    """Build the baselines that apply to a task, in a model of it.

    Args:
        task: the task.
        dynamics: the model, ``(state, action) -> next state``; usually what was learned.
        names: ``"auto"`` for all quick ones that apply, ``"none"``, or names of registered ones.

    Returns:
        Controllers by name.

    Raises:
        ConfigError: for an unknown name, and a named one that does not apply. Of ``"auto"`` such
            ones are left out, and the log says why.

    Examples:
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> task = get_task("acrobot")  # it ends at a height, and has no goal to stay in
        >>> "energy" in make_baselines(task, HybridDynamics.pure_prior(task))
        True
    """
    names = check_names(names)
    found = {}
    for name in BASELINES if names == "auto" else names:
        kind = BASELINES[name]
        if names == "auto" and (kind.slow or not kind.applies(task)):
            continue
        try:
            if not kind.applies(task):
                raise ConfigError("task", f"{task.name!r} is none that it applies to.")
            found[name] = kind.build(task, dynamics)
        except ConfigError as error:
            if names != "auto":
                raise ConfigError("baselines", f"{name!r} does not apply: {error}") from error
            _log.info("The baseline %s is left out: %s", name, error)
    return found


def check_names(names: str | Sequence[str]) -> str | tuple[str, ...]:
    """Return ``"auto"``, or a tuple of registered names, which is empty for ``"none"``.

    Raises:
        ConfigError: for an unknown name.
    """
    if names == "auto":
        return "auto"
    if names == "none":
        return ()
    given = (names,) if isinstance(names, str) else tuple(names)
    for name in given:
        if name not in BASELINES:
            expected = f"auto, none, or a list of {sorted(BASELINES)}"
            raise ConfigError("baselines", f"expected {expected}, got {name!r}.")
    return given


def _lqr(task: Task, dynamics: nn.Module) -> TensorDictModuleBase:
    kind = LQR if task.reference is None else LQI
    return kind.from_model(task, dynamics)


def _mppi(task: Task, dynamics: nn.Module) -> TensorDictModuleBase:
    config = MPPIConfig(
        planning_horizon=20, num_policy_candidates=0, num_candidates=128, select="mean"
    )
    return make_planner(TaskWorldModel(task, dynamics), None, None, config)


register_baseline(
    "lqr",
    _lqr,
    about="linear-quadratic regulator at the goal, or on a reference with integral action",
)
register_baseline("pid", PID.from_model, about="a PID loop for each action, lambda-tuned")
register_baseline(
    "energy",
    EnergyShaping.from_model,
    applies=starts_low,
    about="swing-up by energy shaping, caught by an LQR",
)
register_baseline(
    "mppi", _mppi, about="model-predictive path integral control without a policy", slow=True
)
register_baseline(
    "ilqr", ILQR.from_model, about="model-predictive control by iterative LQR", slow=True
)
