"""The scores of each system on each task, out of all runs."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from measures import DEFAULT_SAMPLES, FEWEST_SEEDS, PUBLISHED_SAMPLES, agent_in
from phihp_torchrl.evaluation import TARGETS
from report.bounds import normalise
from report.paper_systems import AGENT, PaperSystem, has_share
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


def whole_seeds(numbers: Mapping[int, Collection[int]]) -> tuple[set[int], set[int]]:
    """The seeds that were run at every one of some numbers of samples, and these numbers.

    A seed that was run at the most alone would have wide ends, which say how it was planned and not
    how soon it learns, and a mean over other seeds at each number is no curve. The numbers are the
    :func:`well_filled` ones. Where too few seeds have them all, the numbers with the fewest seeds
    are given up, the largest first of those with as many.

    Args:
        numbers: the numbers of real samples of each seed.

    Examples:
        >>> whole_seeds({0: [20, 1000], 1: [20, 1000], 2: [20, 1000], 3: [1000]})
        ({0, 1, 2}, {1000, 20})
    """
    counts = Counter(n for found in numbers.values() for n in found)
    wanted = well_filled(counts.elements())
    enough = FEWEST_SEEDS if max(counts.values(), default=0) >= FEWEST_SEEDS else 1

    def having_all() -> set[int]:
        return {seed for seed, found in numbers.items() if wanted <= {*found}}

    while len(having_all()) < enough and len(wanted) > 1:
        wanted.remove(min(wanted, key=lambda n: (counts[n], -n)))
    return having_all(), wanted


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

    def preset(self, system: PaperSystem) -> str | None:
        """The preset of a system's runs, ``"default"`` where it has none; ``None`` for several."""
        methods = {method for method, _ in system.sources}
        presets = {run.preset for run in self.runs if run.method in methods} or {"default"}
        return presets.pop() if len(presets) == 1 else None

    def usual(self, system: PaperSystem, task: str) -> list[Score]:
        """The scores at the usual number of real samples, by seed."""
        scores = self.scores(system, task)
        return self.at(usual_samples(task, (score.run.samples for score in scores)), system, task)

    def whole(self, system: PaperSystem, task: str) -> list[Score]:
        """The scores of which a curve over real samples is made (:func:`whole_seeds`)."""
        scores = self.scores(system, task)
        numbers: dict[int, set[int]] = defaultdict(set)
        for score in scores:
            numbers[score.run.seed].add(score.run.samples)
        seeds, wanted = whole_seeds(numbers)
        return [s for s in scores if s.run.seed in seeds and s.run.samples in wanted]

    def averaged(
        self, system: PaperSystem, tasks: Sequence[str] = SIX_TASKS
    ) -> list[list[Score]] | None:
        """The usual scores on each of the tasks that an average is over.

        Returns:
            ``None`` if one was not run, or not with the same share of the published samples as the
            others: such an average would be of no budget.
        """
        scores = [self.usual(system, task) for task in tasks]
        if not all(scores):
            return None
        shares = {
            of_task[0].run.samples / PUBLISHED_SAMPLES[task]
            for task, of_task in zip(tasks, scores, strict=True)
            if task in PUBLISHED_SAMPLES and has_share(of_task[0].run.method)
        }
        return scores if len(shares) < 2 else None

    def samples_note(self, system: PaperSystem, task: str) -> str:
        """What stands beside the usual scores: their real samples, if not the default preset's."""
        for score in self.usual(system, task):
            default = DEFAULT_SAMPLES.get(task)
            if default not in (None, score.run.samples) and has_share(score.run.method):
                return f"{score.run.samples} samples"
        return ""

    def at(self, samples: int, system: PaperSystem, task: str) -> list[Score]:
        """The scores at a number of real samples, by seed."""
        return [score for score in self.scores(system, task) if score.run.samples == samples]

    def has_run(self, system: PaperSystem, task: str) -> bool:
        """Whether there is a score."""
        return bool(self.scores(system, task))
