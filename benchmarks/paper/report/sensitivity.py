"""How return and time of an action depend on H, RH, N_π and N_rand."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from matplotlib.figure import Figure

from phihp_torchrl.evaluation import EVALUATION_SEED
from report.sections import Picture, Section
from report.tables import Number, Table, TableCell

SYMBOLS = {
    "planning_horizon": "H",
    "replan_every": "RH",
    "num_policy_candidates": "N_π",
    "num_random_candidates": "N_rand",
}
"""The settings that are swept, and the paper's names of them."""


@dataclass(frozen=True)
class Trial:
    """A trained agent evaluated with one of its planner's settings changed.

    Args:
        task: name of the task.
        seed: seed of the training.
        setting: one of :data:`SYMBOLS`.
        value: its value.
        return_mean: mean return.
        return_std: its standard deviation over episodes.
        episodes: how many.
        milliseconds: mean time of an action, whether it needed a new plan or not.
        first_seed: seed of the episodes; older trials were of evaluation episodes.
        origin: commit and machine.
    """

    task: str
    seed: int
    setting: str
    value: int
    return_mean: float
    return_std: float
    episodes: int
    milliseconds: float
    first_seed: int = EVALUATION_SEED
    origin: str = "commit unknown"


def write_trials(path: Path, trials: Sequence[Trial]) -> None:
    """Write trials as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([asdict(trial) for trial in trials], indent=1) + "\n")


def read_trials(directory: Path) -> tuple[list[Trial], list[str]]:
    """All trials in ``directory``, and a sentence for each file that cannot be read."""
    trials, problems = [], []
    for path in sorted(directory.glob("*.json")):
        try:
            trials += [Trial(**trial) for trial in json.loads(path.read_text())]
        except (OSError, ValueError, TypeError) as error:
            problems.append(f"{path}: left out: {error}")
    return trials, problems


def sensitivity(trials: Sequence[Trial]) -> Section:
    """Curves of return and time, one column for each setting."""
    groups: dict[tuple[str, int, str], list[Trial]] = defaultdict(list)
    for trial in trials:
        groups[trial.task, trial.seed, trial.setting].append(trial)
    rows: list[list[TableCell]] = []
    for t in trials:
        numbers = [Number(x, 1, fixed=True) for x in (t.return_mean, t.return_std)]
        numbers.append(Number(t.milliseconds, 2, fixed=True))
        rows.append([t.task, str(t.seed), SYMBOLS[t.setting], str(t.value), *numbers])
    figure = Figure(figsize=(3.2 * len(SYMBOLS), 5.4), layout="constrained")
    axes = figure.subplots(2, len(SYMBOLS), sharex="col")
    agents = list(dict.fromkeys((trial.task, trial.seed) for trial in trials))
    several = len(agents) > len({task for task, _ in agents})
    for column, (setting, symbol) in enumerate(SYMBOLS.items()):
        for i, (task, seed) in enumerate(agents):
            found = sorted(groups[task, seed, setting], key=lambda trial: trial.value)
            label = f"{task}, {seed}" if several else task
            values = [trial.value for trial in found]
            best = max((abs(trial.return_mean) for trial in found), default=0.0) or 1.0
            returns = [trial.return_mean / best for trial in found]
            axes[0, column].plot(values, returns, "o-", color=f"C{i}", label=label, markersize=3)
            times = [trial.milliseconds for trial in found]
            axes[1, column].plot(values, times, "o-", color=f"C{i}", markersize=3)
        axes[1, column].set_xlabel(symbol)
        for axis in axes[:, column]:
            axis.grid(alpha=0.3)
            if not agents:
                axis.text(0.5, 0.5, "not run", ha="center", transform=axis.transAxes)
    axes[0, 0].set_ylabel("return / largest |return|")
    axes[1, 0].set_ylabel("ms for an action")
    if agents:
        axes[0, -1].legend(fontsize="x-small")
    header = ["task", "seed", "setting", "value", "return", "std over episodes", "ms"]
    text = (
        "A trained agent with one of its planner's settings changed, "
        "`python benchmarks/paper/sensitivity.py`: horizon H, steps between two plans RH, "
        "candidates of the actor N_π, random candidates N_rand."
    )
    played = sorted({(t.episodes, t.first_seed) for t in trials if t.first_seed < EVALUATION_SEED})
    if played:
        text += " Returns of " + " or ".join(f"{n} episodes of seed {seed:,}" for n, seed in played)
        text += ", which no evaluation plays; the time of an action is that of a busy machine."
    looked_at = sorted({t.task for t in trials if t.first_seed >= EVALUATION_SEED})
    if looked_at:
        text += (
            f" In episodes of evaluation, so that no default may follow: {', '.join(looked_at)}."
        )
    if trials:
        text += f" {'; '.join(sorted({t.origin for t in trials}))}."
    return Section(
        "Sensitivity",
        text if trials else f"{text} Not run.",
        {"Trials": Table("sensitivity", header, rows)} if trials else {},
        [Picture("sensitivity", figure, "Return and time of an action over the four settings.")],
    )
