"""What the scripts of this folder have found: a file for each, and one page of all."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import describe_origin, origin_text

RESULTS = Path(__file__).parents[2] / "results" / "robustness"


def write_part(name: str, record: Mapping[str, Any]) -> None:
    """Write what a script has found, and the page with all parts that there are."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    content = {**record, "origin": describe_origin(seed=0)}
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    write_page()


def write_page() -> None:
    """Write the page with all parts that there are."""
    parts = []
    for part, write in PARTS.items():
        place = RESULTS / f"{part}.json"
        if place.is_file():
            found = json.loads(place.read_text(encoding="utf-8"))
            made = f"`python benchmarks/robustness/{part}.py`, {origin_text(found['origin'])}."
            parts.append(f"{write(found).rstrip()}\n\n{made}\n")
    text = "\n".join(["# What runs, agents and plans survive\n", *parts])
    (RESULTS / "README.md").write_text(text, encoding="utf-8")


def _kills(found: Mapping[str, Any]) -> str:
    kills = found["kills"]
    ends = sorted({end for counts in kills.values() for end in counts})
    rows = [[kind, *(str(counts.get(end, 0)) for end in ends)] for kind, counts in kills.items()]
    return (
        "## Killed\n\n"
        "SIGKILL at a random time of a run of all phases, and before one of its "
        f"{found['operations_on_files']} operations on files, evenly among them. A run that is "
        "resumed must end with the states, rows, agent and evaluation of one that nothing "
        f"disturbed. The run took {found['seconds_of_a_run']} s, beside other work, without "
        "pictures.\n\n"
        f"{markdown_table(['killed', *ends], rows)}"
    )


def _flips(found: Mapping[str, Any]) -> str:
    columns = ["refused by name", "noticed and restored", "changes nothing", "silently wrong"]
    rows = [
        [f"`{kind}`", *(str(counts.get(column, 0)) for column in columns)]
        for kind, counts in found["flips"].items()
    ]
    sums = [str(sum(int(row[place]) for row in rows)) for place in range(1, len(columns) + 1)]
    return (
        "## A flipped bit\n\n"
        "One bit of one file at a time, then all that is read back of it.\n\n"
        f"{markdown_table(['file', *columns], [*rows, ['all', *sums]])}"
    )


def _strangers(found: Mapping[str, Any]) -> str:
    return (
        "## Folders of strangers\n\n"
        f"{found['kinds']} kinds of hostile runs and agents were read; {found['executed']} "
        "executed, read or wrote what they named."
    )


def _fuzz_settings(found: Mapping[str, Any]) -> str:
    bad = found["tracebacks"]
    listed = "".join(f"\n- `{text}`" for text in bad)
    return (
        "## Hostile settings\n\n"
        f"{found['settings']} settings of the methods {', '.join(found['methods'])}, with a "
        f"hostile value for one of {found['keys']} keys each, were read and checked against task "
        f"and world as a run does before its first real step: {found['refused']} were refused by "
        f"name, {found['accepted']} accepted. {len(bad)} ended in a traceback, {found['hangs']} "
        f"took longer than {found['limit_seconds']} s. Of those accepted, {found['runs']} small "
        f"runs were made whole: {_counted(found['runs_ended'])}."
        f"{listed}"
    )


def _fuzz_plans(found: Mapping[str, Any]) -> str:
    return (
        "## Hostile plans\n\n"
        f"{found['plans']:,} plans in {found['planners']} planners of random settings (CEM and "
        "MPPI), on all tasks, with models, actors and critics of random weights up to "
        f"{found['largest_scale']:g} times as large, from observations up to "
        f"{found['largest_observation']:g}: {found['not_finite']} were not finite, "
        f"{found['out_of_bounds']} out of bounds. {found['refused']} planners were refused by "
        "name."
    )


def _long_loop(found: Mapping[str, Any]) -> str:
    return (
        "## A long loop\n\n"
        f"{found['steps']:,} steps of control, {found['hours_at_50_hz']:.1f} hours at 50 Hz, made "
        f"without waiting ({found['seconds']:.0f} s): a controller with a small, compiled planner, "
        "the actor as its fallback, in the simulated world. After the first "
        f"{found['warm_up']:,} steps the memory of the process (resident set) grew by "
        f"{found['growth_mib']:.2f} MiB; the most above that was {found['peak_mib']:.2f} MiB."
    )


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in sorted(counts.items())) or "none"


PARTS: dict[str, Callable[[Mapping[str, Any]], str]] = {
    "kills": _kills,
    "flips": _flips,
    "strangers": _strangers,
    "fuzz_settings": _fuzz_settings,
    "fuzz_plans": _fuzz_plans,
    "long_loop": _long_loop,
}
"""Parts of the page: the scripts here, and how what each found is written."""
