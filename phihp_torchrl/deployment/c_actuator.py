"""An actuator in C, for an exported actor: what is under way, and how it moves."""

from __future__ import annotations

import math

from phihp_torchrl.deployment.c_part import CPart
from phihp_torchrl.deployment.c_text import table, whole_table
from phihp_torchrl.tasks import Actuator, one_each


def actuator_in_c(actuator: Actuator, count: int, time_step: float, place: int) -> CPart:
    """The C of an actuator, which moves on as :meth:`phihp_torchrl.tasks.Actuator.step` does.

    Args:
        actuator: the actuator, with registers.
        count: number of actions.
        time_step: seconds in a step.
        place: the first of its registers.

    Examples:
        >>> part = actuator_in_c(Actuator(delay_steps=2.0), count=1, time_step=0.05, place=0)
        >>> part.move
        'move_actuator(memory->registers + 0, memory->command)'
        >>> "enum { DEPTH = 2, SLEWS = 0 };" in part.source
        True
    """
    delays, lags, zones, gains = (
        one_each(value, count)
        for value in (actuator.delay_steps, actuator.lag, actuator.dead_zone, actuator.gain_low)
    )
    depth = max(math.ceil(delay) for delay in delays)
    slews = actuator.slew is not None
    # Where in the registers the lagging value of each action is.
    behind = (depth + slews) * count
    lag_at = [behind + sum(lag > 0 for lag in lags[:i]) for i in range(count)]
    tables = [
        f"enum {{ DEPTH = {depth}, SLEWS = {int(slews)} }};",
        f"static const float time_step = {time_step:.9e}f;",
        whole_table("whole", [math.floor(delay) for delay in delays]),
        table("part", [delay - math.floor(delay) for delay in delays]),
        table("lag", lags),
        whole_table("lag_at", lag_at),
        table("slew", one_each(0.0 if actuator.slew is None else actuator.slew, count)),
        table("dead_zone", zones),
        table("gain_low", gains),
    ]
    own = f"memory->registers + {place}"
    return CPart(
        source="\n".join([*tables, _SOURCE]), move=f"move_actuator({own}, memory->command)"
    )


_SOURCE = """\
static float shape(float x, int i)
{
    float zone = dead_zone[i];
    x -= x < -zone ? -zone : x > zone ? zone : x;
    return x < 0.0f ? gain_low[i] * x : x;
}

/* What is under way moves on: the commands that wait, then slewing and lagging values. */
static void move_actuator(float *own, const float *command)
{
    int i, k, s;
    for (i = 0; i < ACTION; i++) {
        for (s = part[i] > 0.0f ? 0 : 1; s < 2; s++) {
            int steps = whole[i] + 1 - s;
            float share = s ? 1.0f - part[i] : part[i], seconds = share * time_step;
            float value = shape(steps ? own[(DEPTH - steps) * ACTION + i] : command[i], i);
            if (SLEWS) {
                float *at = &own[DEPTH * ACTION + i];
                float gap = value - *at, reach = slew[i] * seconds;
                float moved = fabsf(gap) < reach ? fabsf(gap) : reach;
                float way = gap > 0.0f ? moved : -moved;
                *at += way;
                value = *at - (gap > 0.0f ? 1.0f : -1.0f) * moved * moved / (2.0f * reach);
            }
            if (lag[i] > 0.0f) {
                float *at = &own[lag_at[i]];
                *at = value + (*at - value) * expf(-seconds / lag[i]);
            }
        }
    }
    for (k = 0; k < (DEPTH - 1) * ACTION; k++) own[k] = own[k + ACTION];
    if (DEPTH)
        for (i = 0; i < ACTION; i++) own[(DEPTH - 1) * ACTION + i] = command[i];
}
"""
