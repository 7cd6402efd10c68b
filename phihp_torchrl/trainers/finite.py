"""A run stops where a loss or a weight leaves the finite numbers, and says which."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor


class NonFiniteError(RuntimeError):
    """The error of a run in which a loss or a weight is NaN or infinite.

    The state of that moment is not saved, so the last checkpoint is the last one of before.
    """


def check_finite(
    phase: Any, metrics: Mapping[str, float], *, name: str, unit: str, directory: Path
) -> None:
    """Refuse to go on with losses or weights that are NaN or infinite.

    A mean return or an error of prediction may well be infinite, where a model diverges; a loss and
    a weight may not.

    Args:
        phase: the phase; its method ``trained``, if it has one, returns the tensors that it trains.
        metrics: what its last unit of work has returned.
        name: its name.
        unit: the unit of its progress.
        directory: directory of the run.

    Raises:
        NonFiniteError: naming the phase, how far it is, and the first such loss and tensor.
    """
    losses = [
        f"{key} is {value}"
        for key, value in metrics.items()
        if "loss" in key.rpartition("/")[2] and not math.isfinite(value)
    ]
    trained: Mapping[str, Tensor] = getattr(phase, "trained", dict)()
    bad = [
        f"{key} has {int((~tensor.isfinite()).sum())} of {tensor.numel()} numbers that are not "
        "finite"
        for key, tensor in trained.items()
        if not tensor.isfinite().all()
    ]
    if not losses and not bad:
        return
    done, total = phase.progress
    more = f" (and {len(bad) - 1} tensors more)" if len(bad) > 1 else ""
    found = "; ".join([*losses[:1], *(f"{text}{more}" for text in bad[:1])])
    raise NonFiniteError(
        f"phase {name!r} after {done} of {total} {unit}: {found}. The run has stopped, and this "
        f"state is not saved: {directory} has the last one of before. Resumed, it would come to "
        "the same; start another run with lower learning rates, or from the phases before with "
        f"from={directory}."
    )
