"""The comment at the head of a C file: its functions, and what they take, in which units."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable

from phihp_torchrl.deployment.c_registers import step_signature
from phihp_torchrl.deployment.c_text import in_comment
from phihp_torchrl.tasks import Signal, Task, one_each

_WIDTH = 96


def header(name: str, task: Task) -> str:
    """The first comment of a C file.

    Args:
        name: the beginning of the names of its functions.
        task: the task of the actor.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> lines = header("swing", get_task("pendulum")).splitlines()
        >>> lines[0]
        '/* The actor of an agent for the task pendulum: observation in, action out.'
        >>> lines[6]
        ' *     observation (3): cos(theta), sin(theta), theta_dot'
    """
    functions = [f"int {name}_act(const float *observation, float *action);"]
    if task.register_count:
        functions = [
            f"void {name}_reset({name}_memory *memory);",
            step_signature(name, task) + ";",
            f"void {name}_sent({name}_memory *memory, const float *command);",
            *functions,
        ]
        said = _of_memory(name, task)
    else:
        said = [
            f"{name}_act returns 0, or 1 where a number is not finite, and then the action is the "
            "one nearest to zero."
        ]
    blocks = [
        f"The actor of an agent for the task {in_comment(task.name)}: observation in, action out.",
        textwrap.indent("\n".join(functions), "    "),
        "Arrays have float numbers in physical units, in this order:",
        "\n".join(
            textwrap.fill(each, _WIDTH, initial_indent="    ", subsequent_indent=" " * 8)
            for each in _arrays(task)
        ),
        *(textwrap.fill(each, _WIDTH) for each in said),
        f"Compile without -ffast-math:  cc -O3 -std=c99 -c {name}.c   (link with -lm)\n"
        f"As a program:  cc -O3 -D{name.upper()}_MAIN {name}.c -lm\n" + _of_program(task),
    ]
    lines = "\n\n".join(blocks).splitlines()
    return "\n".join(["/* " + lines[0], *(f" * {line}".rstrip() for line in lines[1:]), " */\n"])


def _joined(names: Iterable[str]) -> str:
    return ", ".join(map(in_comment, names))


def _arrays(task: Task) -> list[str]:
    """What is in each array, with its length."""
    system, bounds = task.system, task.bounds
    seen = [
        f"cos({name}), sin({name})" if name in system.angles else name
        for name in system.state_names
    ]
    limits = zip(system.action_names, bounds.low.tolist(), bounds.high.tolist(), strict=True)
    actions = [f"{name} from {low:g} to {high:g}" for name, low, high in limits]
    if task.action_rate_limit is not None:
        rates = one_each(task.action_rate_limit, task.action_dim)
        actions = [
            f"{action} and changing by at most {rate:g} a second"
            for action, rate in zip(actions, rates, strict=True)
        ]
    return [
        f"observation ({system.observation_dim}): {_joined(seen)}",
        *(_window(key, signal) for key, signal in task.outside.signals.items()),
        f"action, command ({task.action_dim}): {_joined(actions)}",
    ]


def _window(key: str, signal: Signal) -> str:
    names, ahead = _joined(signal.names), signal.preview
    later = f" now, then {names} after each of the next {ahead} steps" if ahead else ""
    return f"{key} ({signal.registers}): {names}{later}"


def _of_memory(name: str, task: Task) -> list[str]:
    """What is to be known of the functions of a task with registers, a paragraph each."""
    keys = list(task.outside.signals)
    within = "its bounds" if task.action_rate_limit is None else "its bounds and its rate"
    refused = "1 where a number is not finite"
    if keys:
        refused += f", or {' or '.join(keys)} has not been given since the reset"
    said = [
        f"{name}_reset: an episode starts, and nothing is under way.",
        f"{name}_step: once in every step of {task.time_step:g} s. It writes the action, within "
        f"{within}, which then counts as sent. It returns 0, or {refused}: then the action is the "
        f"one nearest to zero within {within}, nothing is forgotten, and the next step goes on.",
    ]
    if keys:
        said.append(
            f"{' and '.join(keys)}: where an episode starts, the values must be given. Later NULL "
            "in their place keeps the last ones, which move up by a step while the last row "
            "stays. Values that are not finite are refused as if NULL stood there. A value that is "
            "to stay stands in every row."
        )
    said += [
        f"{name}_sent: after {name}_step, where another command than its action was sent. It is "
        f"taken within {within}; one that is not a number changes nothing.",
        f"{name}_act: the network alone, which keeps neither memory nor rate. Its observation has "
        f"{task.register_count} more numbers at the end, those of "
        f"{_joined(part.name for part in task.registers.parts if part.size)}, each less the middle "
        "of its range, in half-ranges. It returns 0, or 1 where a number is not finite, and then "
        "the action is the one nearest to zero.",
    ]
    return said


def _of_program(task: Task) -> str:
    keys = list(task.outside.signals)
    given = ", ".join(["an observation", *keys])
    instead = f' (or "-" for {" or ".join(keys)} to be NULL)' if keys else ""
    return textwrap.fill(
        f"It reads {given}{instead} and writes an action on a line, again and again.", _WIDTH
    )
