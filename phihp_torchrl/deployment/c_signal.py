"""A reference or inputs in C, for an exported actor: a window of values that moves up."""

from __future__ import annotations

from phihp_torchrl.deployment.c_part import CPart
from phihp_torchrl.tasks import Signal


def signal_in_c(signal: Signal, key: str, place: int, number: int) -> CPart:
    """The C of a signal, which is read and moves up as a :class:`phihp_torchrl.Signal` does.

    Args:
        signal: the signal.
        key: ``"reference"`` or ``"inputs"``, which is the name of its parameter.
        place: the first of its registers.
        number: which of the signals of the task it is.

    Examples:
        >>> part = signal_in_c(Signal(("x",), (-1.0,), (1.0,), preview=3), "reference", 1, 0)
        >>> part.move
        'move_up(memory->registers + 1, 4, 1)'
    """
    own, size = f"memory->registers + {place}", signal.registers
    return CPart(
        source=_SOURCE,
        move=f"move_up({own}, {size}, {signal.size})",
        take=f"take({own}, {size}, {key}, &memory->known[{number}])",
    )


_SOURCE = """\
/* One step later: the rows of a window move up, and its last row stays. */
static void move_up(float *window, int size, int row)
{
    int i;
    for (i = 0; i + row < size; i++) window[i] = window[i + row];
}

/* Replace a window by what is given; 1 if that is not finite, or nothing has ever been given. */
static int take(float *window, int size, const float *given, int *known)
{
    int i;
    if (given == NULL) return !*known;
    for (i = 0; i < size; i++)
        if (!isfinite(given[i])) return 1;
    for (i = 0; i < size; i++) window[i] = given[i];
    *known = 1;
    return 0;
}
"""
