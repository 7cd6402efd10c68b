"""Whether a phase is long enough to earn the compilation of what it does: ``compile: auto``.

Eager and compiled code round differently, so that the choice must not depend on the moment: it
follows from settings and measured rates alone, whether the compiler's cache is warm or not.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from phihp_torchrl.config import resolve_seconds
from phihp_torchrl.display import duration
from phihp_torchrl.evaluation import AT_ONCE
from phihp_torchrl.planners import LONG_PLAN
from phihp_torchrl.trainers.planned_acts import PLANS_END, SEARCH
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.worlds import World

_RATES = json.loads(Path(__file__).with_name("compiling.json").read_text(encoding="utf-8"))
"""What compiling costs and saves; benchmarks/speed/compiling.py writes it."""
_SECONDS, _SAVED = _RATES["seconds"], _RATES["milliseconds"]
# Returns and plans are graphs of steps like those of a chunk.
_STEP, _STEP_SECONDS = (of["chunk"] / _RATES["chunk_steps"] for of in (_SAVED, _SECONDS))
# A round of updates in the file has the gradients of two updates of critics and of one of an actor.
_GRADIENT, _GRADIENT_SECONDS = (of["update"] / 3 for of in (_SAVED, _SECONDS))
_RETURN_SECONDS = 5 * _STEP_SECONDS  # the steps of a compiled piece of a return
# A step of a model alone, for as many rows as a plan has: what it takes does not grow with its
# operations as what it saves does, for a call of a graph has its own price.
_ALONE = _RATES["step"]
# A long plan is a loop in its graph for each iteration, which compiles as long as so many steps.
_LOOP_STEPS = 4
# Lots of episodes that calibration lets plans play: of three ways, of the chosen one, fast ones.
_WAYS = 5
# Learning that may end at a plateau is taken to have this share of its updates.
_PLATEAU = 0.9


@dataclass(frozen=True)
class Earned:
    """What compiling saves in a phase, and what it takes with an empty cache.

    Args:
        saved: seconds that eager code would take more.
        taken: seconds of the compiler; 0 where nothing is compiled.

    Examples:
        >>> Earned(saved=30.0, taken=120.0).pays
        False
    """

    saved: float
    taken: float

    @property
    def pays(self) -> bool:
        """Whether more is saved than taken."""
        return self.saved > self.taken > 0.0

    def words(self, name: str) -> str:
        """A line about the phase ``name`` for the console.

        Examples:
            >>> Earned(saved=30.0, taken=120.0).words("policy")
            'policy runs uncompiled: compiling would take about 2 min and save 30 s.'
        """
        taken, saved = duration(self.taken), duration(self.saved)
        if self.pays:
            return f"{name} is compiled: that takes about {taken} and saves {saved}."
        return f"{name} runs uncompiled: compiling would take about {taken} and save {saved}."


def earned(
    config: RunConfig, name: str, settings: Any, world: World, *, step: bool = False
) -> Earned:
    """What compiling would save in a phase of a run.

    Args:
        config: settings of the run.
        name: name of the phase. Of one that this package has not, nothing is known, and nothing is
            compiled.
        settings: its section, with times in steps.
        world: the world.
        step: whether a step of the model is compiled. Plans then call that; a graph of a plan has a
            dear step many times over, and takes ever longer to compile.

    Examples:
        >>> from phihp_torchrl import load_config, make_world
        >>> from phihp_torchrl.trainers import read_run_config
        >>> world, found = make_world("pendulum"), []
        >>> for preset in ("default", "paper"):
        ...     config = read_run_config(load_config("pendulum", preset=preset))
        ...     found.append(earned(config, "policy", config.section("policy"), world).pays)
        >>> found
        [False, True]
    """
    of = None if step and name == "evaluate" else _PHASES.get(name)
    return of(config, settings, world) if of else Earned(0.0, 0.0)


def earned_by_step(
    config: RunConfig, phases: Sequence[str], world: World, operations: int
) -> Earned:
    """What a compiled step of the model would save in phases that earn no graphs of their own.

    Args:
        config: settings of the run.
        phases: names of the phases that are to come.
        world: the world.
        operations: tensor operations of a step.

    Examples:
        >>> from phihp_torchrl import load_config, make_world
        >>> from phihp_torchrl.trainers import read_run_config
        >>> task = "cartpole-swingup"
        >>> world, config = make_world(task), read_run_config(load_config(task))
        >>> phases = ("policy", "calibrate", "evaluate")
        >>> [earned_by_step(config, phases, world, count).pays for count in (50, 1000)]
        [False, True]
    """
    calls = 0.0
    for name in phases:
        settings = resolve_seconds(config.section(name), world.task.time_step)
        if name in _STEPS and not earned(config, name, settings, world, step=True).pays:
            calls += _STEPS[name](config, settings, world)
    each = operations / _ALONE["operations"]
    saved = max(0.0, each * _ALONE["eager"] - _ALONE["compiled"])
    return Earned(calls * saved / 1e3, each * _ALONE["seconds"] if calls else 0.0)


def _policy(config: RunConfig, settings: Any, world: World) -> Earned:
    td3, refit, steps = settings.td3, settings.refit, world.task.max_steps
    updates = settings.updates * (_PLATEAU if settings.patience else 1.0)
    worlds = 1 + (world.truth is not None and settings.real_evaluation_episodes > 0)
    taken = _RETURN_SECONDS * worlds
    if settings.method == "td3":
        rounds = updates / td3.policy_delay
        each = (td3.policy_delay + 1) * _GRADIENT + (td3.value_expansion - 1) * _STEP
        alone = updates / settings.updates_per_step * (1.0 - _planned(settings))
        saved = rounds * each + alone * _STEP
        taken += _SECONDS["update"] + _SECONDS["chunk"]
    elif settings.method == "analytic":
        horizon, critics = settings.analytic.horizon, settings.analytic.critic_updates
        saved = updates / critics * (2 * horizon * _STEP + (critics + 1) * _GRADIENT)
        taken += _SECONDS["update"] + 2 * _SECONDS["chunk"]  # a step forth, and one back
    else:
        return Earned(0.0, 0.0)
    played = settings.evaluation_steps or steps
    saved += updates / settings.evaluation_interval * worlds * played * _STEP
    if refit.interval:
        saved += refit.fits(updates) * (refit.horizon * _STEP + refit.steps * _GRADIENT)
        taken += _GRADIENT_SECONDS
    return Earned(saved / 1e3, taken)


def _policy_steps(config: RunConfig, settings: Any, world: World) -> float:
    """Calls of the model in imagination; gradients through it are not among them."""
    updates, refit = settings.updates, settings.refit
    played = settings.evaluation_steps or world.task.max_steps
    calls = (1 + updates / settings.evaluation_interval) * played
    if settings.method == "td3":
        plan = SEARCH.planning_horizon * SEARCH.optim_steps
        calls += updates / settings.updates_per_step * (1 + _planned(settings) * plan)
    return calls + refit.fits(updates) * refit.horizon


def _planned(settings: Any) -> float:
    """The share of imagined steps in which plans act in some world, which are not compiled."""
    return PLANS_END if settings.planned > 0.0 else 0.0


def _calibrate_steps(config: RunConfig, settings: Any, world: World) -> float:
    return _WAYS * world.task.max_steps * _plan_steps(config)


def _evaluate_steps(config: RunConfig, settings: Any, world: World) -> float:
    """Calls of the model by plans: of all episodes at once, or of one after the other."""
    at_once = AT_ONCE if world.copies else 1
    alone = math.ceil(settings.episodes / at_once) * world.has_env
    return (alone * world.task.max_steps + settings.latency_actions) * _plan_steps(config)


def _plan_steps(config: RunConfig) -> int:
    planner = config.planner
    return 0 if planner is None else planner.planning_horizon * planner.optim_steps


def _td3(config: RunConfig, settings: Any, world: World) -> Earned:
    played = settings.evaluation_episodes > 0
    saved = settings.real_steps * (
        (settings.policy_delay + 1) * _GRADIENT / settings.round_steps
        + _STEP
        + played * world.task.max_steps / settings.evaluation_interval * _STEP
    )
    taken = _SECONDS["update"] + _SECONDS["chunk"] + _RETURN_SECONDS
    return Earned(saved / 1e3, taken)


def _tdmpc(config: RunConfig, settings: Any, world: World) -> Earned:
    # An update has about as many operations as a round of TD3, and two graphs: values and policy.
    updates = settings.updates_per_step * settings.real_steps
    return Earned(updates * _SAVED["update"] / 1e3, 2 * _SECONDS["update"])


def _evaluate(config: RunConfig, settings: Any, world: World) -> Earned:
    # Where the episodes are a batch, a plan is nearly all arithmetic, and is never compiled.
    if config.planner is None or world.copies or not world.has_env:
        return Earned(0.0, 0.0)
    plans = settings.episodes * world.task.max_steps + settings.latency_actions
    steps = _plan_steps(config)
    looped = config.planner.planning_horizon >= LONG_PLAN
    compiled = _LOOP_STEPS * config.planner.optim_steps if looped else steps
    return Earned(plans * steps * _STEP / 1e3, compiled * _STEP_SECONDS)


_PHASES: dict[str, Callable[[RunConfig, Any, World], Earned]] = {
    "policy": _policy,
    "td3": _td3,
    "tdmpc": _tdmpc,
    "evaluate": _evaluate,
}
_STEPS: dict[str, Callable[[RunConfig, Any, World], float]] = {
    "policy": _policy_steps,
    "calibrate": _calibrate_steps,
    "evaluate": _evaluate_steps,
}
