"""What real transitions say against the task or the fit, told once each."""

from __future__ import annotations

import logging

from tensordict import TensorDict

from phihp_torchrl.dynamics import DynamicsLoss, successive_correlation
from phihp_torchrl.tasks import Task
from phihp_torchrl.worlds import disagreements

_log = logging.getLogger(__name__)

_AGAINST = -0.3
"""The correlation of successive errors below which sensor noise dominates them."""


class Doubts:
    """Warns of what the data contradict, and remembers what it has said."""

    def __init__(self) -> None:
        self._told: set[str] = set()

    def of_task(self, task: Task, data: TensorDict, steps: int, *, last: bool) -> None:
        """Warn where real transitions contradict the task, when first seen and at the end.

        Args:
            task: the task.
            data: all real transitions.
            steps: how many real steps there have been.
            last: whether there will be no more.
        """
        for sentence in disagreements(task, data):
            about = sentence.split(" of ")[0].rstrip("0123456789 ")
            if about not in self._told or last:
                self._told.add(about)
                _log.warning("After %d real steps: %s.", steps, sentence)

    def of_noise(self, loss: DynamicsLoss, data: TensorDict) -> None:
        """Warn, once, where sensor noise dominates the errors of single steps."""
        found = successive_correlation(loss, data)
        noisy = {name: value for name, value in found.items() if value < _AGAINST}
        if noisy and "noise" not in self._told:
            self._told.add("noise")
            _log.warning(
                "The errors of successive steps go against each other (correlation %s), as sensor "
                "noise makes them; it biases a fit of single steps. Take "
                "model.fit.method=multiple_shooting.",
                ", ".join(f"{value:.2f} in {name}" for name, value in noisy.items()),
            )
