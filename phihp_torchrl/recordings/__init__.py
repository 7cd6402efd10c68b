"""Recorded episodes, from any log to the units of a system."""

from __future__ import annotations

from phihp_torchrl.recordings.recording import Recording

__all__ = ["Recording"]
