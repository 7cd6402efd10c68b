"""What a run has warned of, for its page: nobody reads the lines of a long run again."""

from __future__ import annotations

import logging

_PACKAGE = "phihp_torchrl"
_OF_THE_RUN = f"{_PACKAGE}.trainers.interrupt"  # what a stop says is over with the stop


class Warned(logging.Handler):
    """A context that collects the package's warnings, each once; they go to others as well.

    Examples:
        >>> with Warned() as warned:
        ...     logging.getLogger("phihp_torchrl.trainers").warning("It is %s.", "cold")
        >>> warned.texts
        ['It is cold.']
    """

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def __enter__(self) -> Warned:
        logging.getLogger(_PACKAGE).addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger(_PACKAGE).removeHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.name != _OF_THE_RUN and text not in self.texts:
            self.texts.append(text)
