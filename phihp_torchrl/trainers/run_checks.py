"""Whether the task and the world of a run can serve its settings."""

from __future__ import annotations

import logging

import torch

from phihp_torchrl.config import ConfigError, resolve_seconds
from phihp_torchrl.imagination import make_start_states
from phihp_torchrl.tasks import Task, check_functions
from phihp_torchrl.trainers.phases import PHASES
from phihp_torchrl.trainers.policy_config import PolicyConfig
from phihp_torchrl.trainers.run_config import RunConfig
from phihp_torchrl.trainers.strategies import strategies_of
from phihp_torchrl.worlds import World

_log = logging.getLogger(__name__)

# Steps of an episode for each of a discount's time constant, from which on it is short-sighted: the
# paper's tasks have 2 to 5, and with 10 a mountain car climbs.
_SHORT_SIGHTED = 20.0
# Those that TD-MPC2 chooses (Hansen et al., 2024, appendix).
_USUAL = 5.0


def check_run(config: RunConfig, world: World) -> None:
    """Refuse settings that the task or the world of a run cannot serve, before any real step.

    Raises:
        ConfigError: if the system has no prior or the world is not simulated, where one is needed,
            for constants to draw where none are learned, and for seconds that are too few for a
            step of the task or do not fit other settings.
    """
    task = world.task
    check_functions(task)
    for name, section in {**config.sections, "planner": config.planner}.items():
        if section is not None:
            try:
                resolve_seconds(section, task.time_step)
            except ConfigError as error:
                raise error.inside(name) from error
    kind = getattr(config.sections.get("model"), "kind", None)
    if kind in ("hybrid", "prior") and not task.system.has_prior:
        raise ConfigError(
            "model.kind",
            f"method {config.method!r} with a model of kind {kind!r} needs a prior, and the system "
            f"of task {task.name!r}, {type(task.system).__name__}, has none; expected "
            "'data_driven' or a method that needs none.",
        )
    if not world.has_env:
        phases = [name for name in config.phases_to_do if PHASES[name].needs_env]
        if phases:
            raise ConfigError(
                "method",
                f"expected one that does without acting in the world, {config.method!r} acts in it "
                f"in {phases}, and {world} has recordings alone.",
            )
    if isinstance(policy := config.sections.get("policy"), PolicyConfig):
        strategies_of(policy)  # refuses unknown ones
        data = torch.zeros(1, task.state_dim)  # phase 1 will have collected some
        try:
            make_start_states(task, policy.start, data, None if task.coverage is None else data)
        except ConfigError as error:
            raise ConfigError("policy.start", error.reason) from error
        _warn_of_short_sight(task, resolve_seconds(policy, task.time_step).td3.gamma)
    if getattr(config.sections.get("policy"), "draw_constants", False):
        _check_drawing(config, task)
    if world.truth is None:
        phases = [name for name in config.phases_to_do if PHASES[name].needs_truth]
        if phases:
            raise ConfigError(
                "method",
                f"expected one that does without a simulated world, {config.method!r} needs one "
                f"for {phases}, and {world} is none.",
            )
        if kind == "oracle":
            raise ConfigError(
                "model.kind", f"expected another than 'oracle': {world} has no truth to plan with."
            )


def _warn_of_short_sight(task: Task, gamma: float) -> None:
    """Say so where a discount forgets what comes after a small part of an episode."""
    if gamma >= 1.0 or (steps := 1.0 / (1.0 - gamma)) * _SHORT_SIGHTED > task.max_steps:
        return
    seconds = task.time_step
    _log.warning(
        "policy.td3.gamma = %.4g counts rewards for about %.0f steps, which are %.2g s, and "
        "episodes have %d steps, %.4g s. If what matters comes later, give it a time "
        "(policy.td3.gamma='%.2g s'), or choose a longer time_step.",
        gamma,
        steps,
        steps * seconds,
        task.max_steps,
        task.max_steps * seconds,
        task.max_steps * seconds / _USUAL,
    )


def _check_drawing(config: RunConfig, task: Task) -> None:
    """Refuse to draw constants where none are learned, or their fit gives no covariance."""
    model = config.section("model")
    learned = [name for name, c in task.system.ranges.items() if not c.fixed]
    if model.kind not in ("hybrid", "prior") or not learned:
        raise ConfigError(
            "policy.draw_constants",
            f"expected false for a model of kind {model.kind!r} of a system that has "
            f"{len(learned)} constants to learn: there are none to draw.",
        )
    if not model.has_fixed_steps and config.section("policy").constants_std is None:
        raise ConfigError(
            "policy.constants_std",
            f"expected a number with draw_constants=true and model.integrator={model.integrator}, "
            "whose fit has no covariance.",
        )
