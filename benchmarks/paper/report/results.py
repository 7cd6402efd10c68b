"""The scores of each system on each task, out of all runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from measures import DEFAULT_SAMPLES, FEWEST_SEEDS, PUBLISHED_SAMPLES, agent_in
from phihp_torchrl.evaluation import TARGETS
from report.bounds import normalise
from report.paper_systems import AGENT, PaperSystem
from report.planned import Planned
from report.runs import Acting, Run

TASKS = tuple(PUBLISHED_SAMPLES)
"""The tasks in the paper's order, the published variant of CartPoleSwingup among them."""

SIX_TASKS = tuple(TARGETS)
"""The six tasks that averages are over."""


def well_filled(*sides: Iterable[int]) -> set[int]:
    """The numbers of real samples that there are enough seeds of, on each side of a comparison.

    One seed more at another number must not move a comparison there.

    Args:
        sides: the numbers of samples of a side, one for each seed.

    Returns:
        Those with :data:`~measures.FEWEST_SEEDS` on each side; where there are none, all that the
        sides have in common.

    Examples:
        >>> well_filled([200, 200, 200, 1000]), sorted(well_filled([200, 1000], [200, 1000, 2000]))
        ({200}, [200, 1000])
    """
    counts = [Counter(side) for side in sides]
    common = set.intersection(*map(set, counts))
    return {n for n in common if min(side[n] for side in counts) >= FEWEST_SEEDS} or common


def usual_samples(task: str, numbers: Iterable[int]) -> int:
    """The number of real samples to compare at: the default preset's if it is there, or the most.

    Args:
        task: name of the task.
        numbers: the numbers of samples, one for each seed; of :func:`well_filled` ones, if any.

    Examples:
        >>> usual_samples("pendulum", [200, 1000, 2000]), usual_samples("pendulum", [200, 30_000])
        (1000, 30000)
        >>> usual_samples("pendulum", [200, 200, 200, 1000])
        200
    """
    filled, default = well_filled(numbers), DEFAULT_SAMPLES.get(task)
    return default if default is not None and default in filled else max(filled, default=0)


@dataclass(frozen=True)
class Score:
    """What a system earned in one run.

    Args:
        run: the run.
        acting: how it acted: ``"planner"`` or ``"actor"``.
    """

    run: Run
    acting: str

    @property
    def result(self) -> Acting:
        """Its episodes and latency."""
        return self.run.acting[self.acting]

    @property
    def mean(self) -> float:
        """Mean return over its episodes."""
        return self.result.mean

    @property
    def normalised(self) -> float:
        """Mean return from 0 to 1."""
        return normalise(self.run.task, self.mean)

    @property
    def milliseconds(self) -> float | None:
        """Mean time of an action, if measured; where plans are remembered the median is not it."""
        return self.result.latency.get("mean")


class Results:
    """Scores by system and task.

    Args:
        runs: all runs with one label.
        planned: the cells with that label that grids were asked for.
    """

    def __init__(self, runs: Iterable[Run], planned: Planned | None = None) -> None:
        self.runs = tuple(runs)
        self.planned = planned or Planned()

    @property
    def others(self) -> tuple[str, ...]:
        """Tasks that were run and that the paper does not have: they have no published numbers."""
        return tuple(sorted({run.task for run in self.runs} - {*TASKS}))

    @property
    def tasks(self) -> tuple[str, ...]:
        """The paper's tasks, run or not, and the others."""
        return (*TASKS, *self.others)

    def scores(self, system: PaperSystem, task: str) -> list[Score]:
        """All scores of a system on a task, one for each seed and number of samples."""
        found: dict[tuple[int, int], Score] = {}
        for method, wanted in system.sources:
            for run in self.runs:
                if (run.method, run.task) != (method, task):
                    continue
                acting = agent_in(run.acting) if wanted == AGENT else wanted
                acting = acting or next(iter(run.acting))
                if acting in run.acting:
                    found.setdefault((run.samples, run.seed), Score(run, acting))
        return [found[key] for key in sorted(found)]

    def usual(self, system: PaperSystem, task: str) -> list[Score]:
        """The scores at the usual number of real samples, by seed."""
        scores = self.scores(system, task)
        return self.at(usual_samples(task, (score.run.samples for score in scores)), system, task)

    def at(self, samples: int, system: PaperSystem, task: str) -> list[Score]:
        """The scores at a number of real samples, by seed."""
        return [score for score in self.scores(system, task) if score.run.samples == samples]

    def has_run(self, system: PaperSystem, task: str) -> bool:
        """Whether there is a score."""
        return bool(self.scores(system, task))
