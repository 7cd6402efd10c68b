"""Recorded episodes, from any log to the units of a system."""

from __future__ import annotations

from phihp_torchrl.recordings.columns import Column
from phihp_torchrl.recordings.reading import RecordedData, read_recordings
from phihp_torchrl.recordings.recording import Recording, check_columns
from phihp_torchrl.recordings.transitions import transitions
from phihp_torchrl.recordings.velocities import estimate_velocities

__all__ = [
    "Column",
    "RecordedData",
    "Recording",
    "estimate_velocities",
    "read_recordings",
    "transitions",
]
