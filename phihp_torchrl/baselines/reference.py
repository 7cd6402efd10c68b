"""A task's reference as a set point: the components of the state that it is of, and its values."""

from __future__ import annotations

from torch import Tensor

from phihp_torchrl.tasks import Task


def followed(task: Task) -> dict[str, int]:
    """The components of the state that a task's reference is of, and their places.

    There are none without a reference, and where it is of anything else.
    """
    names = () if task.reference is None else task.reference.names
    known = task.system.state_names
    return {name: known.index(name) for name in names} if set(names) <= set(known) else {}


def present(task: Task, registers: Tensor) -> Tensor:
    """The present value of the reference ``[*batch, k]``, from the registers of the task."""
    return task.outside.values(registers)["reference"]


def middle(task: Task) -> tuple[float, ...]:
    """The middle of the wide box, and of the reference in what that is of."""
    box, reference = task.coverage or task.reset, task.reference
    assert reference is not None
    ends = zip(box.low, box.high, strict=True)
    found = [(low + high) / 2 for low, high in ends]
    for name, low, high in zip(reference.names, reference.low, reference.high, strict=True):
        found[task.system.state_names.index(name)] = (low + high) / 2
    return tuple(found)


def held(task: Task, physical: Tensor, at: Tensor) -> Tensor:
    """The state of the task at rest, with a reference that stays at another state's components.

    Args:
        task: the task.
        physical: physical components of the state, ``[n]``.
        at: physical components that the reference has, ``[n]``.
    """
    state = task.at_rest(physical)
    if not (places := followed(task)):
        return state
    assert task.reference is not None
    value = at[list(places.values())]
    return task.with_signals(state, task.reference.read(value, "reference", []))
