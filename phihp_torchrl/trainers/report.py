"""A finished run as one page of HTML, from the files in its directory."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from typing import Any

import torch

from phihp_torchrl.display import cautions, duration, html_page, number
from phihp_torchrl.trainers import report_sections as sections
from phihp_torchrl.trainers.return_curve import read_rows
from phihp_torchrl.trainers.run_directory import RunDirectory, write_atomically
from phihp_torchrl.worlds import World

_log = logging.getLogger(__name__)


def report_run(directory: RunDirectory, world: World) -> None:
    """Write the page of a finished run; if that fails, a warning says why, for the run is whole.

    Args:
        directory: directory of the run.
        world: the world in which it has learned.
    """
    try:
        write_report(directory, true_constants(world))
    except Exception as error:  # a page must never cost a run
        _log.warning("No page of the run in %s: %s", directory.path, error)


def true_constants(world: World) -> dict[str, float] | None:
    """What the motion of a simulated world determines, by name; ``None`` for other worlds.

    Examples:
        >>> from phihp_torchrl.worlds import make_world
        >>> sorted(true_constants(make_world("pendulum")))
        ['gravity_gain', 'torque_gain']
    """
    if world.truth is None:
        return None
    constants = {name: torch.tensor(v) for name, v in world.truth.constants.items()}
    return {k: float(v) for k, v in world.task.system.identifiable(constants).items()}


def write_report(directory: RunDirectory, truth: Mapping[str, float] | None = None) -> str:
    """Write ``report.html``: what was learned, how good it is, and how to go on.

    The page is made from the files of the run alone, so it can be made again at any time. It has
    its style and its pictures in itself and asks no network for anything.

    Args:
        directory: directory of the run.
        truth: true values of what a model learns, in a simulated world, by name.

    Returns:
        The text of the page.
    """
    config, metadata = directory.read_config(), directory.read_metadata()
    rows = read_rows(directory.metrics)
    results: dict[str, Any] = {}
    if directory.evaluation.is_file():
        results = json.loads(directory.evaluation.read_text(encoding="utf-8"))
    title = f"{config['task']}: {config.get('method', 'phihp')}, seed {config['seed']}"
    warned = cautions((text, "") for text in metadata.get("warnings", ()))
    parts = {
        "warnings": ("Warnings", warned),
        "result": ("How good the agent is", sections.result(config, results)),
        "returns": ("Return over real steps", sections.returns(rows)),
        "episode": ("An episode", sections.episode(directory.path)),
        "model": ("How good the model is", sections.model(rows)),
        "learned": ("What was learned", sections.learned(rows, metadata, truth)),
        "settings": ("Settings that differ from the defaults", sections.settings(config)),
        "run": ("The run", sections.origin(metadata)),
        "next": ("How to go on", sections.following(directory.path)),
    }
    page = html_page(title, _tiles(results, rows, metadata), parts)
    write_atomically(directory.path / "report.html", page)
    return page


def _tiles(
    results: Mapping[str, Any], rows: list[dict[str, str]], metadata: Mapping[str, Any]
) -> list[tuple[str, str]]:
    """The run in a few numbers."""
    tiles = []
    for name, words in (("planner", "the agent, planning"), ("actor", "the actor alone")):
        if name in results:
            mean, count = results[name]["return_mean"], int(results[name]["episodes"])
            tiles.append((number(mean), f"mean return over {count} new episodes, {words}"))
    tiles.append((f"{metadata.get('real_steps', 0):,}", "real steps"))
    error = sections.last(rows, "model/rollout_error_20")
    if error is not None:
        tiles.append((number(error, 2), "error of the model 20 steps ahead"))
    seconds = sum(metadata.get("seconds", {}).values())
    tiles.append((duration(seconds), "of training and evaluation"))
    count = len(metadata.get("warnings", ()))
    if count:
        tiles.append((str(count), "warning" if count == 1 else "warnings"))
    return tiles
