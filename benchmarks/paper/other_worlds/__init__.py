"""Worlds that others made, as a user describes them, and how well models of them predict."""

from __future__ import annotations

from other_worlds.measured import STEPS, shares
from other_worlds.worlds import WORLDS, Fit, OtherWorld

__all__ = ["STEPS", "WORLDS", "Fit", "OtherWorld", "shares"]
