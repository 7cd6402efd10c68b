"""The registers of a task's actuator in C, for an exported actor."""

from __future__ import annotations

import math

from phihp_torchrl.tasks import Task


def actuator_source(name: str, task: Task) -> str:
    """The C functions that keep what is under way, as :class:`~phihp_torchrl.tasks.Actuator` does.

    Args:
        name: the beginning of the names.
        task: a task with an actuator that has registers.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task
        >>> from phihp_torchrl.tasks import Actuator
        >>> task = replace(get_task("pendulum"), actuator=Actuator(delay_steps=1.0))
        >>> "void swing_reset(swing_memory *memory)" in actuator_source("swing", task)
        True
    """
    actuator, count = task.actuator, task.action_dim
    assert actuator is not None
    numbers = {
        field: [float(value)] * count if isinstance(value, (int, float)) else list(value)
        for field in ("delay_steps", "lag", "dead_zone", "gain_low")
        for value in [getattr(actuator, field)]
    }
    slew = actuator.slew
    slews = [slew] * count if slew is None or isinstance(slew, float) else list(slew)
    lagging = [lag > 0 for lag in numbers["lag"]]
    depth = max(math.ceil(delay) for delay in numbers["delay_steps"])
    slewing = 0 if slew is None else count
    rows = {
        "whole": [float(math.floor(delay)) for delay in numbers["delay_steps"]],
        "part": [delay - math.floor(delay) for delay in numbers["delay_steps"]],
        "lag": numbers["lag"],
        "slew": [0.0 if each is None else each for each in slews],
        "dead_zone": numbers["dead_zone"],
        "gain_low": numbers["gain_low"],
    }
    tables = [
        f"static const float {key}[] = {{{', '.join(f'{float(v):.9e}f' for v in values)}}};"
        for key, values in rows.items()
    ]
    # Where in the registers the lagging value of each action is.
    places = [depth * count + slewing + sum(lagging[:i]) for i in range(count)]
    tables.append(f"static const int lag_at[] = {{{', '.join(map(str, places))}}};")
    # Which action each register belongs to.
    owners = (
        [*range(count)] * depth + list(range(slewing)) + [i for i in range(count) if lagging[i]]
    )
    tables.append(f"static const int owner[] = {{{', '.join(map(str, owners))}}};")
    sizes = (
        f"enum {{ DEPTH = {depth}, SLEWS = {int(slewing > 0)}, REGISTERS = {len(owners)}, "
        f"SYSTEM = {task.system.observation_dim} }};\n"
        f"static const float time_step = {task.time_step:.9e}f;"
    )
    return "\n".join([sizes, *tables, _SOURCE.replace("NAME", name)])


_SOURCE = """
/* What is under way: the commands that wait, then slewing and lagging values. */
typedef struct { float registers[REGISTERS]; } NAME_memory;

static float shape(float x, int i)
{
    float zone = dead_zone[i];
    x -= x < -zone ? -zone : x > zone ? zone : x;
    return x < 0.0f ? gain_low[i] * x : x;
}

/* At the start of an episode: nothing is under way. */
void NAME_reset(NAME_memory *memory)
{
    int k;
    for (k = 0; k < REGISTERS; k++) {
        float still = clip(0.0f, owner[k]);
        memory->registers[k] = k < DEPTH * ACTION ? still : shape(still, owner[k]);
    }
}

/* Once a step, after NAME_act or in place of its action: this command was sent. */
void NAME_sent(NAME_memory *memory, const float *command)
{
    float *queue = memory->registers, sent[ACTION];
    int i, k, s;
    for (i = 0; i < ACTION; i++) sent[i] = clip(command[i], i);
    for (i = 0; i < ACTION; i++) {
        for (s = part[i] > 0.0f ? 0 : 1; s < 2; s++) {
            int steps = (int)whole[i] + 1 - s;
            float share = s ? 1.0f - part[i] : part[i], seconds = share * time_step;
            float value = shape(steps ? queue[(DEPTH - steps) * ACTION + i] : sent[i], i);
            if (SLEWS) {
                float *at = &memory->registers[DEPTH * ACTION + i];
                float gap = value - *at, reach = slew[i] * seconds;
                float moved = fabsf(gap) < reach ? fabsf(gap) : reach;
                float way = gap > 0.0f ? moved : -moved;
                *at += way;
                value = *at - (gap > 0.0f ? 1.0f : -1.0f) * moved * moved / (2.0f * reach);
            }
            if (lag[i] > 0.0f) {
                float *at = &memory->registers[lag_at[i]];
                *at = value + (*at - value) * expf(-seconds / lag[i]);
            }
        }
    }
    for (k = 0; k < (DEPTH - 1) * ACTION; k++) queue[k] = queue[k + ACTION];
    if (DEPTH)
        for (i = 0; i < ACTION; i++) queue[(DEPTH - 1) * ACTION + i] = sent[i];
}

/* One step: the observation of the system alone to the action, which counts as sent. */
int NAME_step(NAME_memory *memory, const float *observation, float *action)
{
    float seen[OBSERVATION];
    int k, bad;
    for (k = 0; k < SYSTEM; k++) seen[k] = observation[k];
    for (k = 0; k < REGISTERS; k++)
        seen[SYSTEM + k] = (memory->registers[k] - center[owner[k]]) / scale[owner[k]];
    bad = NAME_act(seen, action);
    NAME_sent(memory, action);
    return bad;
}
"""
