"""Which experiment would tell what the data leave open: the same fit, of simulated excitations."""

from __future__ import annotations

import torch
from torch import Tensor

from phihp_torchrl.identification.model import Model
from phihp_torchrl.identification.shooting import Fit, Shooting
from phihp_torchrl.identification.windows import Samples, make_windows

_ROLLOUTS, _LENGTH = 8, 80
_NONE = (
    "No experiment with these measurements tells it by itself: only combinations act on the "
    "motion. Measure one of them otherwise and fix it with Constant(value, fixed=True)"
)


class Experiments:
    """Compares what candidate excitations would say of a direction of the parameters.

    Args:
        model: the fitted equations.
        fit: their parameters, and where the windows of the data start.
        samples: the recordings.
        low: lower bounds of the actions ``[m]``.
        high: upper bounds.
        combined: whether the data determine combinations of constants, which can be used instead.
    """

    def __init__(
        self,
        model: Model,
        fit: Fit,
        samples: Samples,
        low: Tensor,
        high: Tensor,
        *,
        combined: bool = False,
    ) -> None:
        self.model, self.fit, self.samples, self.low, self.high = model, fit, samples, low, high
        self.combined = combined
        self._found: dict[str, Tensor] | None = None

    def advise(self, direction: Tensor) -> str:
        """What would tell a direction ``[p]`` of the parameters, in words."""
        told = {name: float(direction @ m @ direction) for name, m in self._informations().items()}
        best = max(told, key=told.__getitem__, default="")
        if not best or told[best] < 1.0:
            return f"{_NONE}, or use the combinations." if self.combined else f"{_NONE}."
        error = min(told[best] ** -0.5, 9.99)
        return (
            f"It shows best in {best}: as many samples of that would leave a standard error of "
            f"about {100 * error:.2g} %."
        )

    def _informations(self) -> dict[str, Tensor]:
        """Information of each candidate, for as many samples as the fit had, ``[p, p]``."""
        if self._found is None:
            self._found = {}
            for name, (command, faster) in self._candidates().items():
                information = self._information(command, faster)
                if information.isfinite().all():
                    self._found[name] = information
        return self._found

    def _candidates(self) -> dict[str, tuple[Tensor, float]]:
        """Commands ``[length, m]`` of each candidate, and a factor of the speeds it starts with."""
        t = torch.arange(_LENGTH, dtype=torch.float64) * self.samples.step
        middle, half = (self.high + self.low) / 2.0, (self.high - self.low) / 2.0
        whole = float(t[-1])

        def sweep(first: float, last: float) -> Tensor:
            phase = 2 * torch.pi * (first * t + (last - first) * t.square() / (2 * whole))
            return middle + half * phase.sin()[:, None]

        rest = torch.zeros(len(self.low), dtype=torch.float64).clamp(self.low, self.high)
        return {
            "a step to the upper bound of the action": (self.high.expand(_LENGTH, -1), 1.0),
            "a step to the lower bound of the action": (self.low.expand(_LENGTH, -1), 1.0),
            "a slow sweep of the action over its whole range": (sweep(0.5 / whole, 2 / whole), 1.0),
            "a fast sweep of the action over its whole range": (sweep(2 / whole, 16 / whole), 1.0),
            "a free motion without action": (rest.expand(_LENGTH, -1), 1.0),
            "a free motion at three times the speed": (rest.expand(_LENGTH, -1), 3.0),
        }

    def _information(self, command: Tensor, faster: float) -> Tensor:
        system, seconds = self.model.prior.system, self.samples.step
        pick = torch.linspace(0, len(self.fit.starts) - 1, _ROLLOUTS).round().long()
        starts = self.fit.starts[pick].clone()
        for velocity in system.velocity_of.values():
            starts[:, system.state_names.index(velocity)] *= faster
        count = _ROLLOUTS * _LENGTH
        rows = torch.arange(count)
        measured = self.samples.state.isfinite().any(0)
        unseen = torch.where(measured, 0.0, torch.nan).double()
        samples = Samples(
            time=(rows % _LENGTH) * seconds,
            state=unseen.expand(count, -1),
            action=command.repeat(_ROLLOUTS, 1),
            interval=torch.full((count,), seconds, dtype=torch.float64),
            stretch=rows // _LENGTH,
            first=rows // _LENGTH * _LENGTH,
            place=rows % _LENGTH,
        )
        spans = [(i * _LENGTH, (i + 1) * _LENGTH) for i in range(_ROLLOUTS)]
        shooting = Shooting(self.model, samples, make_windows(samples, spans))
        shooting.scale = Shooting(self.model, self.samples, shooting.windows).scale
        information = shooting.information(self.fit.raw, starts, self.fit.sigma)
        return information * (len(self.samples.time) / count)
