"""The grid on the terminal while it runs."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from grid.cell import CellFiles
from grid.committed import check_committed
from grid.display import failures, summary, table
from grid.keep import keep_names
from grid.status import CellState, Status, look
from grid.sweep import swept_cells
from phihp_torchrl.config import ConfigError


class LiveTable(Callback):
    """Hydra's callback that shows all cells, whichever launcher runs them.

    It looks at the cells' files, so it needs no word from the workers. On a terminal the table is
    drawn anew in its place; elsewhere each change of a cell is a line. At the end come the table,
    the errors, and exit code 1 if a cell failed.
    """

    def __init__(self) -> None:
        self._cells: list[CellFiles] = []
        self._states: dict[CellFiles, CellState] = {}
        self._lines = 0
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return LiveTable, ()  # workers get one that shows nothing

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Refuse a wrong cell or code without a commit; then note what is planned, and watch."""
        base: Any = OmegaConf.to_container(config, resolve=False)
        hydra = base.pop("hydra")
        root = Path(config.hydra.runtime.cwd)
        params = [f"{key}={value}" for key, value in (hydra["sweeper"].get("params") or {}).items()]
        try:
            self._cells = swept_cells(base, [*params, *hydra["overrides"]["task"]], root)
            if not base["allow_dirty"]:
                check_committed()
            keep_names(self._cells)
        except ConfigError as error:
            sys.exit(f"error: {error}")
        if base["refresh"]:
            self._thread = threading.Thread(target=self._watch, args=(base["refresh"],))
            self._thread.daemon = True
            self._thread.start()

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Show how the grid ended; exit with 1 if a cell failed."""
        if self._thread is None:
            self._look()
            _write([*table(self._states), summary([*self._states.values()])])
        else:
            self._over.set()
            self._thread.join()
        if config.only_plan:
            return
        if failed := failures(self._states):
            _write([*failed, "Try them again with retry_failed=true."])
            sys.exit(1)

    def _watch(self, refresh: float) -> None:
        while not self._over.wait(refresh):
            self._show()
        self._show(last=True)

    def _look(self) -> list[CellFiles]:
        """Look at all cells that may have changed; returns those that have."""
        changed = []
        for files in self._cells:
            before = self._states.get(files)
            if before is not None and before.status is Status.DONE:
                continue
            self._states[files] = state = look(files)
            if before is None or before.status is not state.status:
                changed.append(files)
        return changed

    def _show(self, *, last: bool = False) -> None:
        changed = self._look()
        count = summary([*self._states.values()])
        if sys.stdout.isatty():
            # Up to the table's first line, and everything below it is wiped.
            up = f"\x1b[{self._lines}F\x1b[J" if self._lines else ""
            lines = [*table(self._states), count]
            self._lines = len(lines)
            _write([up + lines[0], *lines[1:]])
        elif last:
            _write(["", *table(self._states), count])
        else:
            states = ((files, self._states[files]) for files in changed)
            _write(
                f"{files.cell.name}: {state.status.value} {state.detail}".rstrip()
                for files, state in states
                if state.status is not Status.WAITING
            )


def _write(lines: Any) -> None:
    for line in lines:
        sys.stdout.write(f"{line}\n")
    sys.stdout.flush()
