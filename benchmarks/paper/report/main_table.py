"""The paper's main table: return, sample efficiency and time of an action, beside the published."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from phihp_torchrl.evaluation import PUBLISHED, Published
from report.efficiency import ONE_NUMBER, samples_cell
from report.paper_systems import PaperSystem, systems
from report.results import Results
from report.sections import Section
from report.tables import Ends, Stat, Table, TableCell


def main_table(results: Results) -> Section:
    """A table for each of the three metrics."""

    def returns(system: PaperSystem, task: str) -> Stat:
        scores, note = results.usual(system, task), results.samples_note(system, task)
        return Stat(tuple(score.mean for score in scores), note=note)

    def samples(system: PaperSystem, task: str) -> Ends | str:
        return samples_cell(results, system, task)

    def milliseconds(system: PaperSystem, task: str) -> Stat:
        times = (score.milliseconds for score in results.usual(system, task))
        note = results.samples_note(system, task)
        return Stat(tuple(time for time in times if time is not None), 2, note)

    return Section(
        "Main table",
        "Mean ± std over seeds (number of seeds); under *published*, the paper's numbers, mean ± "
        "std over 10 runs, times on an Apple M1. The paper's CartPoleSwingup is "
        "`cartpole-swingup-published`. Returns and times are those at the default preset's "
        "number of real samples, or at the most of which there are enough seeds, where the number "
        "stands beside them. Times are those of runs, which compile nothing and share the machine; "
        "*At a glance* has compiled ones. Real samples to 90 % are known by their ends alone: "
        "between the evaluation that first reached it and the one before; what stands is what the "
        "mean over seeds lies between, and ≤ where the first evaluation was there already. Runs "
        f"with {ONE_NUMBER} of real samples do not say it.",
        {
            "Return": _table("main_return", results.tasks, returns, _published_return),
            "Real samples to 90 % of the best return": _table(
                "main_samples", results.tasks, samples, _published_samples
            ),
            "Milliseconds for an action, mean": _table(
                "main_milliseconds", results.tasks, milliseconds, _published_milliseconds
            ),
        },
    )


def _table(
    name: str,
    tasks: Sequence[str],
    ours: Callable[[PaperSystem, str], TableCell],
    theirs: Callable[[Published], str],
) -> Table:
    columns = systems("ours", "baseline")
    header, rows = ["task"], []
    for system in columns:
        header += [system.name, f"{system.name}, published"]
    for task in tasks:
        row: list[TableCell] = [task]
        for system in columns:
            published = PUBLISHED.get(task, {}).get(system.name)
            row += [ours(system, task), "–" if published is None else theirs(published)]
        rows.append(row)
    return Table(name, header, rows)


def _published_return(published: Published) -> str:
    return f"{published.return_mean:.0f} ± {published.return_std:.0f}".replace("-", "−")


def _published_samples(published: Published) -> str:
    return "none" if published.samples is None else f"{1000 * published.samples:.0f}"


def _published_milliseconds(published: Published) -> str:
    return f"{published.milliseconds:g}"
