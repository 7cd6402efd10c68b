r"""What a user of the defaults gets on the six tasks: returns, smoothness, and the time it takes.

    python benchmarks/paper/run_grid.py proof=true 'seed=range(150,160)' share=0.5 \
        task=pendulum,pendulum-swingup,cartpole,cartpole-swingup,acrobot,acrobot-swingup
    python benchmarks/paper/six_tasks.py

Reads the kept runs of default settings with training seeds from 100 on, those of the last proof,
and writes a README.md beside them, and the first columns into README.md. With ``--results`` it
reads others, and leaves README.md alone. It runs nothing and chooses nothing. Means are over
training seeds, and so are their intervals: episodes of one seed share their agent, so that a seed
counts once.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path

from measures import DEFAULT_SAMPLES, agent_in, mean_of_seeds
from phihp_torchrl.evaluation import PUBLISHED, REPORT_SEED, TARGETS, markdown_table
from report.cells import configurations
from report.overview import origins
from report.runs import Run, read_runs
from report.time_to_return import median_seconds_to
from report.write import put_between

RESULTS = Path("results/runs")
START, END = "<!-- results:start -->", "<!-- results:end -->"
"""Between these the README has the table."""
_AIMS = json.loads((Path(__file__).parent / "aims.json").read_text())["tasks"]
AIMS = {task: float(aim["return"]) for task, aim in _AIMS.items()}
"""Mean returns of version 0.1.0, below which none should fall; the file says of which runs."""


def ours(runs: Sequence[Run], task: str) -> list[Run]:
    """The default runs of a task with reporting seeds and the default number of real samples."""
    wanted = ("phihp", "default", task, DEFAULT_SAMPLES[task])
    kept = [run for run in runs if (run.method, run.label, run.task, run.samples) == wanted]
    return sorted((run for run in kept if run.seed >= REPORT_SEED), key=lambda run: run.seed)


def chatter(run: Run, name: str) -> float:
    """Mean change of the action in the second halves of the episodes, in half-ranges."""
    evaluation = json.loads((run.folder / "evaluation.json").read_text())
    return float(evaluation[name].get("chatter", math.nan))


def times(runs: Sequence[Run], level: float) -> str:
    """The median of the seconds to a return, and how many runs got there, if not all."""
    middle, reached = median_seconds_to(runs, level)
    text = "–" if middle is None else f"{middle:.0f}"
    return text if reached == len(runs) else f"{text} ({reached} of {len(runs)})"


def spread(values: Sequence[float], digits: int) -> str:
    """A mean over seeds with the 95 % interval of Student's t, where there are two or more."""
    found = mean_of_seeds(values)
    if found is None:
        return "–"
    if math.isnan(found.low):
        return f"{found.mean:.{digits}f}"
    return f"{found.mean:.{digits}f} [{found.low:.{digits}f}, {found.high:.{digits}f}]"


def row(task: str, runs: Sequence[Run]) -> list[str]:
    """The row of a task."""

    def each(value: Callable[[Run], float]) -> list[float]:
        return [value(run) for run in runs]

    published = PUBLISHED.get(task, {}).get("PhIHP")
    return [
        task,
        str(len(runs)),
        f"{runs[0].samples:,}",
        spread(each(lambda run: run.acting[agent_in(run.acting)].mean), 1),
        f"{AIMS[task]:g}",
        spread(each(lambda run: run.acting["actor"].mean), 1),
        spread(each(lambda run: chatter(run, agent_in(run.acting))), 3),
        spread(each(lambda run: chatter(run, "actor")), 3),
        "–" if published is None else times(runs, published.return_mean),
        f"{sum(each(lambda run: sum(run.seconds.values()))) / len(runs):.0f}",
    ]


def page(runs: Sequence[Run]) -> str:
    """The results as a page.

    Raises:
        ValueError: for runs of several configurations, which have no mean in common.
    """
    found = {task: ours(runs, task) for task in TARGETS}
    if mixed := [task for task, those in found.items() if configurations(those) > 1]:
        raise ValueError(f"{', '.join(mixed)}: expected runs of one configuration, got several.")
    used = [run for those in found.values() for run in those]
    header = ["task", "seeds", "real steps", "agent", "aim", "actor", "agent's chatter",
              "actor's chatter", "s to published", "s in all"]  # fmt: skip
    rows = [row(task, those) for task, those in found.items() if those]
    missing = [task for task, those in found.items() if not those]
    seeds = ", ".join(str(seed) for seed in sorted({run.seed for run in used}))
    commits = ", ".join(sorted({run.commit for run in used}))
    machines = "; ".join(sorted({run.machine for run in used}))
    return (
        "# The six tasks from defaults\n\n"
        "Made by `python benchmarks/paper/six_tasks.py` from the runs of `run_grid.py` in the "
        "folders beside it. Do not edit. *Agent* is what is saved: its plans, or its actor where "
        "calibration in imagination found that no plan earns more. *Chatter* is the mean change of "
        "the action from step to step in the second half of an episode, in half-ranges. *aim* is "
        "the return of version 0.1.0 (`benchmarks/paper/aims.json` says of which runs). *s to "
        "published* are the seconds of a run, its real steps and the fits of its model among them, "
        "until it first earned the published mean return of PhIHP: its actor in ten episodes of "
        "the world during training or in the fifty at the end, or else its plans in those, when "
        "the calibration counts too. It is the median over the runs, those that never "
        "did among them as longer than any (how many did, if not all); *s in all* has "
        "calibration and the evaluation of 50 episodes too. Brackets are 95 % intervals over "
        "training seeds.\n\n"
        f"{markdown_table(header, rows)}\n"
        + (f"Not run yet: {', '.join(missing)}.\n\n" if missing else "")
        + f"Training seeds {seeds}. Commits: {commits}. Machines: {machines}, shared with other "
        "work, so that times are upper bounds.\n"
    )


def brief(runs: Sequence[Run]) -> str:
    """What somebody new wants to know first, for README.md."""
    header = ["task", "seeds", "real steps", "return", "chatter", "paper", "paper's steps"]
    rows, used = [], []
    for task in TARGETS:
        if not (those := ours(runs, task)):
            continue
        used += those
        name, count, steps, agent, _, _, calm, *_ = row(task, those)
        theirs = PUBLISHED.get(task, {}).get("PhIHP")
        paper = ["–", "–"]
        if theirs is not None:
            assert theirs.samples is not None  # PhIHP's are known
            mean, std = theirs.return_mean, theirs.return_std
            paper = [f"{mean:g} ± {std:g}", f"{1000 * theirs.samples:,.0f}"]
        rows.append([name, count, steps, agent, calm.split(" ")[0], *paper])
    return f"{markdown_table(header, rows)}\n{origins(used)}"


def main() -> None:
    """Read and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=RESULTS, help="where the runs are")
    results = parser.parse_args().results
    runs = read_runs(results, any_version=True).runs
    if not any(ours(runs, task) for task in TARGETS):
        parser.exit(1, f"{results}: expected default runs of seeds from {REPORT_SEED} on.\n")
    text = page(runs)
    (results / "README.md").write_text(text)
    if results == RESULTS:  # and not others' runs
        put_between(Path("README.md"), START, END, brief(runs))
    print(text)


if __name__ == "__main__":
    main()
