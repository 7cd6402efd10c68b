"""The program in a C file: it reads observations and signals, and writes actions, line by line."""

from __future__ import annotations

from string import Template

from phihp_torchrl.tasks import Task


def program_source(name: str, task: Task) -> str:
    """The program that ``-DNAME_MAIN`` makes of a C file.

    Args:
        name: the beginning of the names of the file's functions.
        task: the task of the actor.

    Examples:
        >>> from phihp_torchrl import get_task
        >>> "swing_act(observation, action);" in program_source("swing", get_task("pendulum"))
        True
    """
    sizes = {"observation": task.system.observation_dim}
    sizes |= {key: signal.registers for key, signal in task.outside.signals.items()}
    remembers = task.register_count > 0
    function = f"{name}_step(&memory, " if remembers else f"{name}_act("
    return _PROGRAM.substitute(
        NAME=name.upper(),
        rooms="".join(f"    float {key}_room[{size}];\n" for key, size in sizes.items()),
        pointers=", ".join(f"*{key}" for key in sizes),
        memory=f"    {name}_memory memory;\n" if remembers else "",
        reset=f"    {name}_reset(&memory);\n" if remembers else "",
        read="\n           && ".join(
            f"numbers({key}_room, {size}, &{key})" for key, size in sizes.items()
        ),
        call=f"{function}{', '.join(sizes)}, action);",
    )


_PROGRAM = Template("""\
#ifdef ${NAME}_MAIN
#include <stdio.h>
#include <stdlib.h>

/* Read some numbers, or a "-" in place of them, which is NULL; 0 where there are no more. */
static int numbers(float *room, int count, const float **given)
{
    char word[64], *end;
    int i;
    *given = NULL;
    for (i = 0; i < count; i++) {
        if (scanf("%63s", word) != 1) return 0;
        if (i == 0 && word[0] == '-' && word[1] == 0) return 1;
        room[i] = strtof(word, &end);
        if (*end) return 0;
    }
    *given = room;
    return 1;
}

int main(void)
{
${rooms}    const float ${pointers};
    float action[ACTION];
    int i;
${memory}${reset}    while (${read}) {
        if (observation == NULL) return 1;
        ${call}
        for (i = 0; i < ACTION; i++) printf("%.9g%c", action[i], i < ACTION - 1 ? ' ' : '\\n');
        fflush(stdout);
    }
    return 0;
}
#endif
""")
