"""What studies that choose a default in imagination share."""

from __future__ import annotations

from studies.imagined import Trained, study, train

__all__ = ["Trained", "study", "train"]
