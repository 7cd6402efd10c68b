"""The last action in C, for an exported actor: it is remembered, and limits the next one."""

from __future__ import annotations

from phihp_torchrl.deployment.c_part import CPart
from phihp_torchrl.deployment.c_text import table
from phihp_torchrl.tasks import Task, one_each


def last_action_in_c(task: Task, place: int) -> CPart:
    """The C of a task's last action, which does as :class:`phihp_torchrl.tasks.LastAction` does.

    Args:
        task: a task that keeps its last action.
        place: the first of its registers.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl import get_task
        >>> task = replace(get_task("pendulum"), action_rate_limit=5.0)
        >>> last_action_in_c(task, 0).limit
        'within_rate(memory->registers + 0, memory->command)'
    """
    own = f"memory->registers + {place}"
    remember = CPart(source=_REMEMBER, move=f"remember({own}, memory->command)")
    if task.action_rate_limit is None:
        return remember
    changes = [rate * task.time_step for rate in one_each(task.action_rate_limit, task.action_dim)]
    return CPart(
        source="\n".join([_REMEMBER, table("largest_change", changes), _WITHIN_RATE]),
        move=remember.move,
        limit=f"within_rate({own}, memory->command)",
    )


_REMEMBER = """\
static void remember(float *last, const float *command)
{
    int i;
    for (i = 0; i < ACTION; i++) last[i] = command[i];
}
"""

_WITHIN_RATE = """\
/* The nearest command that is near enough to the last one. */
static void within_rate(const float *last, float *command)
{
    int i;
    for (i = 0; i < ACTION; i++) {
        float least = last[i] - largest_change[i], most = last[i] + largest_change[i];
        command[i] = command[i] < least ? least : command[i] > most ? most : command[i];
    }
}
"""
