"""Keep the list of the default preset's departures from the paper in step with the YAML files.

    python docs/departures.py

It compares the two presets on every task and rewrites the table of docs/recipes.md: the settings
as runs compose them, the measured effects from results/departures/. The column "why" is people's
and stays as it is; a departure that is new gets an empty reason. mkdocs runs it as a hook, which
only checks: a table that is out of date or a departure without a reason stops the build.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import yaml

from phihp_torchrl.config import YAML, flatten, load_config

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "recipes.md"
START, END = "<!-- departures:start -->\n", "<!-- departures:end -->"
HEADER = "| # | key | paper | default | why | measured effect |\n|---:|:---|:---|:---|:---|:---|\n"
EFFECTS = ROOT / "results" / "departures" / "departures.json"


def departures() -> dict[str, tuple[str, str]]:
    """The published and our settings of each key in which some task departs, as Markdown."""
    paper, ours = settings("paper"), settings("default")
    return {
        key: (_describe(paper[key]), _describe(ours[key]))
        for key in ours
        if key not in ("task", "preset") and paper[key] != ours[key]
    }


def settings(preset: str) -> dict[str, dict[str, Any]]:
    """The value of each key by task, as ``phihp train`` composes it."""
    tasks = sorted(path.stem for path in (YAML / "task").glob("*.yaml"))
    layers = {task: flatten(load_config(task, preset=preset)) for task in tasks}
    return {key: {task: layer[key] for task, layer in layers.items()} for key in layers[tasks[0]]}


def table(page: str) -> str:
    """The table as it should be, with the reasons that ``page`` has."""
    effects = json.loads(EFFECTS.read_text()) if EFFECTS.exists() else {}
    reasons = {}
    for line in page.split(START)[1].split(END)[0].splitlines()[2:]:
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        reasons[cells[1].strip("`")] = cells[4]
    rows = [
        f"| {number} | `{key}` | {paper} | {ours} | {reasons.get(key, '')} "
        f"| {effects.get(key, {}).get('effect', 'not measured')} |\n"
        for number, (key, (paper, ours)) in enumerate(departures().items(), 1)
    ]
    return HEADER + "".join(rows)


def on_pre_build(config: Any) -> None:
    """Stop mkdocs where the page and the presets disagree."""
    from mkdocs.exceptions import Abort

    page = PAGE.read_text()
    if table(page) not in page:
        raise Abort("docs/recipes.md: its departures are out of date: python docs/departures.py")
    if unexplained := _unexplained(page):
        raise Abort(f"docs/recipes.md: departures without a reason: {unexplained}")


def main() -> None:
    """Rewrite the table."""
    page = PAGE.read_text()
    before, rest = page.split(START)
    page = before + START + table(page) + END + rest.split(END)[1]
    PAGE.write_text(page)
    if unexplained := _unexplained(page):
        sys.exit(f"docs/recipes.md: please say why: {unexplained}")


def _unexplained(page: str) -> list[str]:
    rows = [line.split(" | ") for line in page.split(START)[1].split(END)[0].splitlines()[2:]]
    return [cells[1].strip("`") for cells in rows if not cells[4].strip()]


def _describe(values: dict[str, Any]) -> str:
    """The value that most tasks have first, then the tasks that have another."""
    groups: dict[str, list[str]] = {}
    for task, value in values.items():
        groups.setdefault(_show(value), []).append(task)
    if len(groups) == 1:
        return f"`{next(iter(groups))}`"
    sizes = sorted((len(tasks) for tasks in groups.values()), reverse=True)
    first, texts = sizes[0] > sizes[1], []
    for value, tasks in sorted(groups.items(), key=lambda group: -len(group[1])):
        texts.append(f"`{value}`" if first else f"`{value}` ({', '.join(tasks)})")
        first = False
    return "; ".join(texts)


def _show(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return yaml.safe_dump(value, default_flow_style=True).removesuffix("\n...\n").strip()


if __name__ == "__main__":
    main()
