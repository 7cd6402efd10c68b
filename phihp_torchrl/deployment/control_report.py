"""What a controller says of the steps that it took."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

_KEPT = 100_000
"""Steps whose times are kept."""


@dataclass(frozen=True)
class ControlReport:
    """The result of :meth:`Controller.report <phihp_torchrl.deployment.Controller.report>`.

    Args:
        steps: steps taken.
        reasons: steps that another controller took, by the reason (one of
            ``phihp_torchrl.deployment.safety.REASONS``).
        taken_by: the same steps, by who took over.
        longest: the most of them in a row.
        milliseconds: time of each step, ``[steps]``; of the last 100,000 at most.

    Examples:
        >>> times = torch.tensor([1.0, 3.0])
        >>> report = ControlReport(2, {"late": 1}, {"actor": 1}, 1, times)
        >>> report.overruled, report.summary()["late"], str(report)
        (1, 1.0, '2 steps, 1 by another controller (late 1; by actor 1; at most 1 in a row)')
    """

    steps: int
    reasons: Mapping[str, int]
    taken_by: Mapping[str, int]
    longest: int
    milliseconds: Tensor

    @property
    def overruled(self) -> int:
        """Steps that another controller took."""
        return sum(self.reasons.values())

    def summary(self) -> dict[str, float]:
        """Steps, counts and quantiles of the time of a step, as numbers for a table or a logger."""
        found = {"steps": float(self.steps), "overruled": float(self.overruled)}
        found |= {reason: float(count) for reason, count in self.reasons.items()}
        if len(self.milliseconds):
            quantiles = {"p50_ms": 0.5, "p99_ms": 0.99, "p99_9_ms": 0.999}
            found |= {k: self.milliseconds.quantile(q).item() for k, q in quantiles.items()}
        return found

    def __str__(self) -> str:
        text = f"{self.steps} steps, {self.overruled} by another controller"
        if not self.overruled:
            return text
        why, who = (
            ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))
            for counts in (self.reasons, self.taken_by)
        )
        return f"{text} ({why}; by {who}; at most {self.longest} in a row)"


class Tally:
    """Counts the steps of a controller.

    Examples:
        >>> tally = Tally()
        >>> tally.overruled("late", "actor")
        >>> tally.took(12.0)
        >>> tally.report().longest
        1
    """

    def __init__(self) -> None:
        self._steps = self._run = self._longest = 0
        self._reasons: Counter[str] = Counter()
        self._taken_by: Counter[str] = Counter()
        self._milliseconds = array("d", bytes(8 * _KEPT))  # a ring: it takes no more memory later

    def acted(self) -> None:
        """The agent has acted."""
        self._run = 0

    def overruled(self, reason: str, name: str) -> None:
        """Another controller has acted, for this reason."""
        self._reasons[reason] += 1
        self._taken_by[name] += 1
        self._run += 1
        self._longest = max(self._longest, self._run)

    def took(self, milliseconds: float) -> None:
        """A step has ended."""
        self._milliseconds[self._steps % _KEPT] = milliseconds
        self._steps += 1

    def report(self) -> ControlReport:
        """The counts so far."""
        times = torch.tensor(self._milliseconds[: self._steps], dtype=torch.float64)
        return ControlReport(
            steps=self._steps,
            reasons=dict(self._reasons),
            taken_by=dict(self._taken_by),
            longest=self._longest,
            milliseconds=times.roll(-(self._steps % _KEPT)) if self._steps > _KEPT else times,
        )
