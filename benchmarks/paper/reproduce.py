"""Make one published number again, and print it beside the committed one.

    python benchmarks/paper/reproduce.py acrobot --seed 150
    python benchmarks/paper/reproduce.py pendulum --method td3-im-dd --seed 2 --share 0.5

Trains and evaluates one cell of the grid as ``run_grid.py`` does, in a temporary folder, and
compares its mean returns with those in results/runs. The same code, settings and kind of machine
give the same number; another commit or settings are named. A method has the settings that the grid
gives it; those that a grid was asked for besides are given with ``--overrides``. A cell of the last
proof plays the episodes of the proof again, by the code of a commit.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from grid import CellFiles, GridConfig, Status, work
from measures import configuration_hash
from phihp_torchrl.config import ConfigError
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text

RUNS = Path("results/runs")
GRID = Path(__file__).parent / "config" / "grid.yaml"
_WAYS = ("planner", "actor")


def beside(committed: CellFiles, made: CellFiles) -> str:
    """A table of mean returns, committed and made again, and what else differs."""
    old, new = (json.loads(files.evaluation.read_text()) for files in (committed, made))
    rows = []
    for way in _WAYS:
        if way in old and way in new:
            before, after = old[way]["return_mean"], new[way]["return_mean"]
            numbers = (before, after, after - before)
            rows.append([way, *(f"{number:.1f}".replace("-", "−") for number in numbers)])
    text = markdown_table(["acting", "committed", "made again", "difference"], rows)
    settings = [configuration_hash(_settings(files)) for files in (committed, made)]
    if settings[0] != settings[1]:
        text += f"\nThe settings are others by now: {'; '.join(_changes(committed, made))}.\n"
    session = json.loads((committed.kept / "metadata.json").read_text())["sessions"][0]
    now = describe_origin(committed.cell.seed)
    return text + f"\nCommitted: {origin_text(session)}. Made again: {origin_text(now)}.\n"


def _is_proof(committed: CellFiles) -> bool:
    """Whether the cell is of the last proof; those of earlier versions do not say it."""
    cell = committed.kept / "cell.json"
    return cell.is_file() and bool(json.loads(cell.read_text()).get("proof", False))


def _method_overrides() -> dict[str, tuple[str, ...]]:
    """The settings that the grid gives methods besides their own."""
    given = yaml.safe_load(GRID.read_text())["method_overrides"]
    return {method: tuple(settings) for method, settings in given.items()}


def _settings(files: CellFiles) -> dict[str, Any]:
    return yaml.safe_load((files.kept / "config.yaml").read_text())


def _changes(committed: CellFiles, made: CellFiles) -> list[str]:
    """The settings that differ, by dotted name."""
    old, new = (dict(_flat(_settings(files))) for files in (committed, made))
    names = sorted(name for name in {*old, *new} if old.get(name) != new.get(name))
    free = ("seed", "run_dir", "logger", "progress", "evaluate.video", "plugins")
    return [
        f"{name} {old.get(name, 'not there')} → {new.get(name, 'not there')}"
        for name in names
        if not name.startswith(free)
    ]


def _flat(settings: dict[str, Any], start: str = "") -> list[tuple[str, Any]]:
    flat: list[tuple[str, Any]] = []
    for key, value in settings.items():
        name = f"{start}{key}"
        flat += _flat(value, f"{name}.") if isinstance(value, dict) else [(name, value)]
    return flat


def main() -> None:
    """Train, evaluate and compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task")
    parser.add_argument("--method", default="phihp")
    parser.add_argument("--seed", type=int, default=150)
    parser.add_argument("--share", type=float, default=0.5, help="of the published real samples")
    parser.add_argument("--label", default="default")
    parser.add_argument("--runs", type=Path, default=RUNS, help="folder of the committed runs")
    parser.add_argument("--overrides", nargs="*", default=[], help="as the grid was given them")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        try:
            config = GridConfig(
                options.method,
                options.task,
                options.seed,
                options.share,
                options.label,
                overrides=("evaluate.video=false", *options.overrides),
                allow_dirty=True,  # it is compared, not kept
                runs=f"{place}/runs",
                results=f"{place}/results",
                method_overrides=_method_overrides(),
            )
        except ConfigError as error:
            parser.error(str(error))
        made = config.files(Path())
        committed = CellFiles(made.cell, made.runs, options.runs)
        if not committed.evaluation.is_file():
            parser.error(f"{committed.kept}: expected a committed run, there is none.")
        if _is_proof(committed):
            config = replace(config, proof=True, allow_dirty=False)
        try:
            state = work(config, Path())
        except ConfigError as error:
            parser.exit(1, f"{made.cell.name}: {error}\n")
        if state.status is not Status.DONE:
            parser.exit(1, f"{made.cell.name}: {state.status.value}: {state.detail}\n")
        print(beside(committed, made))


if __name__ == "__main__":
    main()
