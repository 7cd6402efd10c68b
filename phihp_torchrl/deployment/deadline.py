"""A function that is given up at a deadline, and goes on in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import torch


class DeadlineWorker:
    """Runs one function at a time in a thread, and gives up waiting for it at a deadline.

    A function that is late goes on, and its result is lost. Until it ends, others are late too,
    because what it uses (a planner's memory, say) is not made for two threads at once.

    Examples:
        >>> worker = DeadlineWorker()
        >>> worker.run(lambda: 2, timeout=1.0)
        2
        >>> worker.close()
    """

    def __init__(self) -> None:
        self._executor: ThreadPoolExecutor | None = None
        self._running: Future[Any] | None = None

    @property
    def busy(self) -> bool:
        """Whether a late function is still at work."""
        return self._running is not None and not self._running.done()

    def run(self, function: Callable[[], Any], timeout: float | None) -> Any:
        """Return what the function returns.

        Raises:
            TimeoutError: if it takes longer than ``timeout`` seconds, or an earlier one is at work.
        """
        if self.busy and timeout is not None:
            raise TimeoutError("an earlier call is still at work")
        if self._executor is None:
            self._executor = ThreadPoolExecutor(1, "phihp-control", _like_this_thread())
        self._running = self._executor.submit(function)
        return self._running.result(timeout)

    def close(self) -> None:
        """End the thread, after the function that it runs."""
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None


def _like_this_thread() -> Callable[[], None]:
    """Copy torch's number of threads and its treatment of denormals, which each thread has."""
    threads = torch.get_num_threads()
    flushes = bool((torch.full((1,), 2e-38) * 0.1 == 0.0).all())

    def prepare() -> None:
        torch.set_num_threads(threads)
        torch.set_flush_denormal(flushes)

    return prepare
