"""What a run has on record besides the states of its phases: settings, metrics, metadata."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchrl.checkpoint import CheckpointError

from phihp_torchrl.trainers.checkpoints import clear_rotation
from phihp_torchrl.trainers.files import remove_stages
from phihp_torchrl.trainers.metrics_table import MetricsTable, Row, read_rows, rows_to_keep
from phihp_torchrl.trainers.phases import Phase
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.start import open_metadata, settings_digest


class RunRecord:
    """The record of a run: its part of every checkpoint, and the files that are made from that.

    A checkpoint has the rows of ``metrics.csv`` and the digest of the settings, so that a file
    which is damaged, cut or gone is noticed when the run is resumed, and the table is written anew.

    Args:
        directory: directory of the run, whose ``config.yaml`` must be as it was at the start.

    Raises:
        ConfigError: for settings that were edited.
    """

    def __init__(self, directory: RunDirectory) -> None:
        self.directory = directory
        remove_stages(directory.path)
        self.metadata = open_metadata(directory)
        self.settings = settings_digest(directory)
        self.rows: list[Row] | None = []
        """The rows before the last checkpoint; ``None`` if it is of a version that has none."""

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint has of the record."""
        return {"settings": self.settings, "rows": self.rows}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a checkpoint; one of an earlier version has nothing of the record.

        Raises:
            CheckpointError: if it was made with other settings.
        """
        if state.get("settings", self.settings) != self.settings:
            raise CheckpointError(
                f"{self.directory.path}: its checkpoint of phase {state.get('phase')!r} was made "
                "with other settings than those in config.yaml, which was edited or damaged, or "
                "the checkpoint is of another run."
            )
        rows = state.get("rows")
        self.rows = None if rows is None else [dict(row) for row in rows]

    def note(self, name: str, phase: Phase, *, seconds: Mapping[str, float], steps: int) -> None:
        """Note in the metadata what a phase that is done has come to."""
        self.metadata["seconds"] = {k: round(v, 3) for k, v in seconds.items()}
        self.metadata["real_steps"] = steps
        if hasattr(phase, "summary"):
            self.metadata[name] = phase.summary
        if hasattr(phase, "digests"):
            self.metadata["digests"] = phase.digests

    def write(self) -> None:
        """Write the metadata."""
        self.directory.write_metadata(self.metadata)

    def open_table(self, unit: int) -> MetricsTable:
        """The table of metrics up to a unit of work, which later rows are added to."""
        path = self.directory.metrics
        table = MetricsTable(path, rows_to_keep(path, self.rows, unit))
        self.rows = table.rows
        return table

    def complete(self, phases: Mapping[str, Any], unit: int) -> None:
        """Complete what a run that has done everything has left, or lost since."""
        clear_rotation(self.directory.rotation)
        path = self.directory.metrics
        rows = rows_to_keep(path, self.rows, unit)
        if rows != read_rows(path):
            MetricsTable(path, rows)
        for phase in phases.values():
            if hasattr(phase, "restore_files"):
                phase.restore_files()
        self.write()
