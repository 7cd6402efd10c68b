"""What the last fit of the critics is worth to the plan, and what it costs.

    python benchmarks/paper/refits.py --tasks pendulum-swingup --seeds 20 21
    python benchmarks/paper/refits.py --only-write       # the table of what there is

Trains actor and critics in the fitted models of the agents in results/agents, by the task's default
settings but for that fit, which some leave out. The plan of the default preset then plays paired
imagined episodes with the critics as they were before their last fit to returns, and with the
fitted ones. No real step is taken and no real episode played. Writes
results/refits/{task}-seed{seed}.json and README.md.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from measures import paired_difference
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.origin import origin_text
from phihp_torchrl.trainers import PolicyTrainer
from studies import study, train

RESULTS = Path("results/refits")
EPISODES = 24
FIT = "policy.refit.interval=2000"
"""A fit at the end, also where the task's settings leave it out; any number above 0 says so."""


class LastFit(PolicyTrainer):
    """Keeps the critics as they were before each fit, and the seconds that it takes."""

    unfitted: Any = None
    seconds_of_fits = 0.0

    def _refit_critics(self) -> dict[str, float]:
        self.unfitted, start = self.best_qvalue(), time.process_time()
        found = super()._refit_critics()
        self.seconds_of_fits += time.process_time() - start
        return found


def measure(task: str, seed: int) -> dict[str, Any]:
    """Train, and play both plans."""
    trained = train(task, seed, [FIT], LastFit)
    trainer = trained.trainer
    return {
        "returns": {
            "before": trained.plan(EPISODES, qvalue=trainer.unfitted),
            "fitted": trained.plan(EPISODES),
        },
        "seconds_of_fits": trainer.seconds_of_fits,
        "seconds": trained.seconds,
    }


def page(runs: Sequence[dict[str, Any]]) -> str:
    """A row for each task and seed."""
    rows = []
    for run in runs:
        before, fitted = run["returns"]["before"], run["returns"]["fitted"]
        gain = paired_difference(torch.tensor(fitted), torch.tensor(before))
        share = run["seconds_of_fits"] / run["seconds"]
        rows.append(
            [
                f"{run['task']}, {run['seed']}",
                f"{sum(before) / len(before):.1f}",
                f"{sum(fitted) / len(fitted):.1f}",
                f"{gain.mean:+.2f} ± {gain.standard_error:.2f}",
                f"{run['seconds_of_fits']:.1f}",
                f"{share:.0%}",
            ]
        )
    header = ["task, seed", "before the fit", "after", "gain ± s.e.", "CPU s", "share of training"]
    origins = "; ".join(sorted({origin_text(run["origin"]) for run in runs}))
    return (
        "# The last fit of the critics\n\nMade by `python benchmarks/paper/refits.py`. Do not edit."
        f" Imagined returns of the default preset's plan in {EPISODES} paired episodes, with the "
        "critics before and after they are fitted to returns, once at the end of training, also "
        f"where the settings leave that out (`{FIT}`). The error is over episodes, of one training "
        "each."
        f"\n\n{markdown_table(header, rows)}\n\n{origins}.\n"
    )


if __name__ == "__main__":
    study(__doc__.splitlines()[0], RESULTS, measure, page)
