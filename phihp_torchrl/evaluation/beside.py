"""Baselines beside an agent: the same episodes, in the agent's own model, and a table of all."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from phihp_torchrl.baselines import check_names, make_baselines
from phihp_torchrl.deployment import Agent
from phihp_torchrl.evaluation.latency import measure_latency
from phihp_torchrl.evaluation.returns import evaluate
from phihp_torchrl.evaluation.seeds import EVALUATION_SEED
from phihp_torchrl.evaluation.table import markdown_table
from phihp_torchrl.evaluation.violations import is_violation
from phihp_torchrl.worlds import World

DOING = "playing controllers by hand"
"""What a run says that it is doing while this is on its stack."""

_log = logging.getLogger(__name__)

BASELINES_KEY = "baselines"
"""The key of evaluation.json under which the baselines' results are, each under its name."""
_LATENCY_ACTIONS = 100
"""The most actions whose time is measured, of a baseline: they are all alike."""


def play_baselines(
    agent: Agent,
    world: World,
    names: str | Sequence[str] = "auto",
    *,
    episodes: int = 50,
    seed: int = EVALUATION_SEED,
    latency_actions: int = 0,
) -> dict[str, dict[str, Any]]:
    """Play the baselines that apply to an agent's task, built in the agent's model.

    Args:
        agent: the agent; without a model it has no baselines.
        world: the world. ``"auto"`` plays in simulated worlds alone, for nobody asked to have
            another one, which may be a machine, moved by hand-made controllers; names do.
        names: ``"auto"``, ``"none"``, or names of registered baselines.
        episodes: number of episodes.
        seed: seed of the episodes; with the agent's, they are the same ones.
        latency_actions: actions whose time is measured, at most 100; 0 for none.

    Returns:
        What an evaluation says of each, by name.

    Raises:
        ConfigError: for an unknown name, or a named one that does not apply.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import HybridDynamics, get_task
        >>> from phihp_torchrl.agents import Actor
        >>> from phihp_torchrl.worlds import SimulatedWorld
        >>> task = replace(get_task("pendulum"), max_steps=5)
        >>> agent = Agent(task, dynamics=HybridDynamics.pure_prior(task), actor=Actor(task))
        >>> found = play_baselines(agent, SimulatedWorld(task), ["lqr"], episodes=2)
        >>> found["lqr"]["episodes"]
        2.0
    """
    names = check_names(names)
    if not names or not world.has_env:
        return {}
    if agent.dynamics is None:
        if names != "auto":
            _log.warning("baselines: the agent has no model, in which they could be built.")
        return {}
    if names == "auto" and world.truth is None:
        _log.info(
            "Baselines are not played in %s unless they are named, e.g. baselines=[lqr].", world
        )
        return {}
    results = {}
    for name, controller in make_baselines(agent.task, agent.dynamics, names).items():
        acting = Agent(agent.task, actor=controller)  # which remembers what is under way
        played = evaluate(acting, agent.task, episodes=episodes, seed=seed, world=world)
        results[name] = {**played.summary(), "returns": played.returns.tolist()}
        if calls := min(latency_actions, _LATENCY_ACTIONS):
            latency = measure_latency(acting, agent.task, calls=calls, warmup=3, seed=seed)
            results[name] |= latency.summary()
    return results


def controllers_table(title: str, results: Mapping[str, Mapping[str, Any]]) -> str:
    """A table with a row for each controller: return, its standard error, chatter, time.

    Where the task has constraints: the share of steps and of episodes that violate each, and the
    largest violation.

    Args:
        title: heading of the first column.
        results: what evaluations say, by controller; columns that none has are left out.

    Examples:
        >>> print(controllers_table("pendulum", {"lqr": {"returns": [-2.0, -4.0]}}))
        | pendulum | return | s.e. |
        |:---|---:|---:|
        | lqr | -3.0 | 1.0 |
        <BLANKLINE>
    """
    columns = {"chatter": "chatter", "ms": "latency_ms_mean"}
    for key in dict.fromkeys(k for each in results.values() for k in each if is_violation(k)):
        columns[key.removeprefix("violations/").replace("/", ": ").replace("_", " ")] = key
    shown = {c: k for c, k in columns.items() if any(k in each for each in results.values())}
    rows = []
    for name, result in results.items():
        returns = result["returns"]
        mean = sum(returns) / len(returns)
        spread = sum((value - mean) ** 2 for value in returns) / max(1, len(returns) - 1)
        cells = [f"{result[k]:.3f}" if k in result else "–" for k in shown.values()]
        rows.append([name, f"{mean:.1f}", f"{(spread / len(returns)) ** 0.5:.1f}", *cells])
    return markdown_table([title, "return", "s.e.", *shown], rows)
