"""How far a run is, and how long it still takes, from what was expected and what was measured."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from phihp_torchrl.display.words import duration

_TRUSTED = 0.2
"""Share of a phase from which on its own speed counts alone, and what was expected not at all."""
_MOST = 4.0
"""The most by which finished phases stretch or shrink what is expected of later ones."""


class Forecast:
    """The share of a run that is done, and the time that is left.

    A phase that has begun is judged by its own speed the more it has done. Later phases are
    expected to be as much slower or faster than foretold as the finished ones were.

    Args:
        expected: seconds for each phase, by name in order; ``None`` where nobody knows.
        clock: seconds since any moment.

    Examples:
        >>> now = 0.0
        >>> forecast = Forecast({"model": 20.0, "policy": 60.0}, clock=lambda: now)
        >>> forecast.begin("model", 0.0)
        >>> forecast.end(40.0)  # twice as long as expected
        >>> forecast.begin("policy", 0.0)
        >>> forecast.now()
        (0.25, 'about 2 min left', 0.0)
    """

    def __init__(
        self, expected: Mapping[str, float | None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.expected, self.clock = dict(expected), clock
        self._spent: dict[str, float] = {}  # seconds of finished phases
        self._phase = ""
        self._seconds = 0.0  # of the present phase, at the end of its last unit
        self._left: float | None = None  # in the present phase, at that moment
        self._since = clock()

    def restored(self, phase: str, seconds: float) -> None:
        """A phase was done before; a phase that this run does not have does not count."""
        if phase in self.expected:
            self._spent[phase] = seconds

    def begin(self, phase: str, share: float) -> None:
        """A phase begins, of which a resumed run may have done a share already."""
        self._phase, self._seconds, self._since = phase, 0.0, self.clock()
        foretold = self._foretold(phase)
        self._left = None if foretold is None else (1.0 - share) * foretold

    def advance(self, share: float, seconds: float) -> None:
        """The phase has done a share of its work in so many seconds."""
        foretold, self._seconds, self._since = self._foretold(self._phase), seconds, self.clock()
        own = seconds * (1.0 - share) / share if share > 0.0 else None
        if own is None or foretold is None:
            self._left = own if foretold is None else (1.0 - share) * foretold
            return
        trust = min(1.0, share / _TRUSTED)
        self._left = trust * own + (1.0 - trust) * (1.0 - share) * foretold

    def end(self, seconds: float) -> None:
        """The phase is done."""
        self._spent[self._phase], self._since = seconds, self.clock()
        self._phase, self._seconds, self._left = "", 0.0, 0.0

    def now(self) -> tuple[float | None, str, float]:
        """The share of the run that is done, the time left in words, and the age of the last news.

        The share is ``None`` where the time left is not known.
        """
        since = self.clock() - self._since
        names = list(self.expected)
        first = names.index(self._phase) + 1 if self._phase in names else len(self._spent)
        later = [self._foretold(name) for name in names[first:]]
        known = sum(seconds for seconds in later if seconds is not None)
        spent = sum(self._spent.values()) + self._seconds + since
        if self._left is None:
            least = f", at least {duration(known)} after this phase" if known else ""
            return None, f"time left not known yet{least}", since
        here = self._left - since
        if here <= 0.0 < self._left:
            words = "this part takes longer than expected"
            return None, f"{words}, then about {duration(known)}" if known else words, since
        left = max(here, 0.0) + known
        about = "at least" if None in later else "about"
        share = spent / (spent + left) if spent + left else 0.0
        return share, f"{about} {duration(left)} left", since

    def _foretold(self, phase: str) -> float | None:
        seconds = self.expected.get(phase)
        if seconds is None:
            return None
        pairs = [(s, self.expected.get(name)) for name, s in self._spent.items()]
        taken = sum(s for s, e in pairs if e)
        foretold = sum(e for _, e in pairs if e)
        factor = taken / foretold if foretold and taken else 1.0
        return seconds * min(max(factor, 1.0 / _MOST), _MOST)
