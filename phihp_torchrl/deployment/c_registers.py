"""What a task adds to its state in C, for an exported actor: memory, and the functions on it."""

from __future__ import annotations

from collections.abc import Iterable
from string import Template

import torch

from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment.c_actuator import actuator_in_c
from phihp_torchrl.deployment.c_last_action import last_action_in_c
from phihp_torchrl.deployment.c_part import CPart
from phihp_torchrl.deployment.c_signal import signal_in_c
from phihp_torchrl.deployment.c_text import table
from phihp_torchrl.tasks import ActuatorPart, LastAction, SignalPart, Task


def parts_in_c(task: Task) -> list[CPart]:
    """The C of each part of a task's registers, in their order.

    Args:
        task: the task.

    Raises:
        ConfigError: for a part that has no C, such as an estimated disturbance; the message names
            it.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task
        >>> [part.limit for part in parts_in_c(replace(get_task("pendulum"), action_rate_cost=0.1))]
        ['']
    """
    found, place, signals = list[CPart](), 0, 0
    for part in task.registers.parts:
        if type(part) is SignalPart:
            found.append(signal_in_c(part.signal, part.name, place, signals))
            signals += 1
        elif type(part) is ActuatorPart:
            if part.size:
                moved = actuator_in_c(part.actuator, task.action_dim, task.time_step, place)
                found.append(moved)
        elif type(part) is LastAction:
            found.append(last_action_in_c(task, place))
        else:
            raise ConfigError(
                "agent",
                "expected a task that adds no more to its state than a reference, inputs, an "
                f"actuator and the last action, for C, got {part.name!r} (an estimated disturbance "
                "needs the model); export the actor as ONNX, and keep the state in a Controller.",
            )
        place += part.size
    return found


def step_signature(name: str, task: Task) -> str:
    """The signature of ``NAME_step``, with a parameter for each signal of the task.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> step_signature("swing", get_task("pendulum"))
        'int swing_step(swing_memory *memory, const float *observation, float *action)'
    """
    start = f"int {name}_step("
    signals = [f"const float *{key}" for key in task.outside.signals]
    first = f"{name}_memory *memory, const float *observation"
    rest = ", ".join([*signals, "float *action"])
    between = ",\n" + " " * len(start) if signals else ", "
    return f"{start}{first}{between}{rest})"


def registers_source(name: str, task: Task) -> str:
    """The memory of an exported actor and the functions on it, which do as an agent's memory does.

    They go behind ``NAME_act``, ``clip`` and ``nearest_to_zero``.

    Args:
        name: the beginning of the names.
        task: a task with registers.

    Raises:
        ConfigError: for a part that has no C.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task
        >>> task = replace(get_task("pendulum"), action_rate_limit=5.0)
        >>> "void swing_reset(swing_memory *memory)" in registers_source("swing", task)
        True
    """
    parts, signals = parts_in_c(task), len(task.outside.signals)
    like = torch.zeros(1)
    middle, half_range = task.registers.scales(like)
    sizes = {"SYSTEM": task.system.observation_dim, "REGISTERS": task.register_count}
    sizes |= {"SIGNALS": signals} if signals else {}
    functions = _FUNCTIONS.substitute(
        name=name,
        step=step_signature(name, task),
        known=_lines(
            ["int known[SIGNALS];         /* whether each has been given */"] if signals else []
        ),
        forget=_lines(["for (i = 0; i < SIGNALS; i++) memory->known[i] = 0;"] if signals else []),
        take=_lines(f"bad |= {part.take};" for part in parts if part.take),
        move=_lines(f"{part.move};" for part in parts),
        limit=_lines(f"{part.limit};" for part in parts if part.limit),
    )
    sources = dict.fromkeys(part.source for part in parts)  # signals share theirs
    return "\n".join(
        [
            f"enum {{ {', '.join(f'{key} = {size}' for key, size in sizes.items())} }};\n",
            table("at_rest", task.rest(like)),
            table("middle", middle),
            table("half_range", half_range),
            *sources,
            functions,
        ]
    )


def _lines(statements: Iterable[str]) -> str:
    return "".join(f"    {each}\n" for each in statements)


_FUNCTIONS = Template("""\
typedef struct {
    float registers[REGISTERS]; /* what an observation shows behind the system's, physical */
    float command[ACTION];      /* what was sent in the last step, and acts until the next */
${known}} ${name}_memory;

void ${name}_reset(${name}_memory *memory)
{
    int i;
    for (i = 0; i < REGISTERS; i++) memory->registers[i] = at_rest[i];
    for (i = 0; i < ACTION; i++) memory->command[i] = clip(0.0f, i);
${forget}}

void ${name}_sent(${name}_memory *memory, const float *command)
{
    int i;
    for (i = 0; i < ACTION; i++)
        if (isnan(command[i])) return;
    for (i = 0; i < ACTION; i++) memory->command[i] = clip(command[i], i);
${limit}}

${step}
{
    float seen[OBSERVATION];
    int i, bad = 0;
    /* What was sent in the last step has acted by now: here, so that ${name}_sent may change it. */
${move}${take}    for (i = 0; i < SYSTEM; i++) seen[i] = observation[i];
    for (i = 0; i < REGISTERS; i++)
        seen[SYSTEM + i] = (memory->registers[i] - middle[i]) / half_range[i];
    bad = bad ? nearest_to_zero(action) : ${name}_act(seen, action);
    ${name}_sent(memory, action);
    for (i = 0; i < ACTION; i++) action[i] = memory->command[i];
    return bad;
}
""")
