"""An actor as one file of C99, for a controller without Python: float32, libm, and no more."""

from __future__ import annotations

import re
from pathlib import Path

from torch import nn

from phihp_torchrl.agents import Actor
from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment.c_header import header
from phihp_torchrl.deployment.c_program import program_source
from phihp_torchrl.deployment.c_registers import registers_source
from phihp_torchrl.deployment.c_text import table
from phihp_torchrl.deployment.export_modules import ActorModule

_ACTIVATIONS = {
    nn.ReLU: "x < 0.0f ? 0.0f : x",  # what is no number stays so, and is refused
    nn.Tanh: "tanhf(x)",
    nn.SiLU: "x / (1.0f + expf(-x))",
}


def export_c(module: ActorModule, path: str | Path) -> Path:
    """Write an actor as one C file without dependencies, from observation to action.

    The file has ``int NAME_act(const float *observation, float *action)``, where NAME is the name
    of the file. It returns 0, or 1 where a number is not finite, and then writes the action nearest
    to zero. ``cc -DNAME_MAIN`` makes a program that reads observations and writes actions, line by
    line. The comment at the head of the file says what there is, in which units and order.

    Where the task has an actuator, a limit or a price of the action's rate, a reference or inputs,
    the file also keeps what they add to the state, as an :class:`~phihp_torchrl.Agent` does:

    - ``NAME_memory``, a struct, and ``void NAME_reset(NAME_memory *memory)``, which is called where
      an episode starts.
    - ``int NAME_step(NAME_memory *memory, const float *observation, const float *inputs, const
      float *reference, float *action)``, which is called once a step. The observation is that of
      the system alone, and a signal that the task does not have is no parameter. A signal is its
      window ``[rows, k]``, row by row in physical units, the present value first. It must be given
      where an episode starts; later ``NULL`` keeps the last window, moved up by a step. The action
      is in its bounds and within the rate limit. The function returns 1 for numbers that are not
      finite and for a signal that has never been given; it then writes the action nearest to zero
      that the rate limit allows, and keeps the last window.
    - ``void NAME_sent(NAME_memory *memory, const float *command)``, which is told, after
      ``NAME_step``, of a command that was sent in place of its action.

    Args:
        module: the actor, a network of linear layers with ReLU, tanh or SiLU.
        path: the file to write, ending in ``.c``.

    Returns:
        The path.

    Raises:
        ConfigError: for an actor of another make, and for a task with an estimated disturbance,
            whose estimate needs the model; the message names it.

    Examples:
        >>> import tempfile
        >>> from dataclasses import replace
        >>> from phihp_torchrl import Agent, get_task
        >>> task = replace(get_task("pendulum"), action_rate_limit=5.0)
        >>> module = ActorModule(Agent(task, actor=Actor(task, (8,))))
        >>> with tempfile.TemporaryDirectory() as place:
        ...     lines = export_c(module, f"{place}/swing.c").read_text().splitlines()
        >>> lines[3]
        ' *     int swing_step(swing_memory *memory, const float *observation, float *action);'
    """
    path, task, actor = Path(path), module.task, module.network
    name = path.stem
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ConfigError("path", f"expected a name of a C function before .c, got {name!r}.")
    if not isinstance(actor, Actor):
        raise ConfigError("agent", f"expected an Actor for C, got a {type(actor).__name__}.")
    registers = registers_source(name, task) if task.register_count else None
    bounds = task.bounds
    tables = {"low": bounds.low, "high": bounds.high, "center": bounds.center}
    parts = [header(name, task), "#include <math.h>\n#include <stddef.h>\n"]
    parts += [f"enum {{ OBSERVATION = {task.observation_dim}, ACTION = {task.action_dim} }};\n"]
    parts += [table(key, values) for key, values in (tables | {"scale": bounds.scale}).items()]
    calls = []
    size = width = task.observation_dim
    for i, layer in enumerate(actor.mlp):
        if isinstance(layer, nn.Linear):
            parts.append(table(f"weight_{i}", layer.weight.T))
            parts.append(table(f"bias_{i}", layer.bias))
            width = layer.out_features
            sizes = f"{layer.in_features}, {width}"
            calls.append(f"    linear(weight_{i}, bias_{i}, {sizes}, x, y);")
            calls.append(f"    for (i = 0; i < {width}; i++) x[i] = y[i];")
            size = max(size, width)
        elif type(layer) in _ACTIVATIONS:
            parts.append(f"static float f_{i}(float x) {{ return {_ACTIVATIONS[type(layer)]}; }}\n")
            calls.append(f"    for (i = 0; i < {width}; i++) x[i] = f_{i}(x[i]);")
        else:
            raise ConfigError(
                "agent",
                f"expected linear layers with {[each.__name__ for each in _ACTIVATIONS]} for C, "
                f"got a {type(layer).__name__}.",
            )
    parts.append(_ACT.format(name=name, size=size, layers="\n".join(calls)))
    parts += [] if registers is None else [registers]
    parts.append(program_source(name, task))
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


_ACT = """\
/* y = W x + b; the rows of W are stored as columns, so that a compiler can use vectors. */
static void linear(const float *weight, const float *bias, int inputs, int outputs,
                   const float *x, float *y)
{{
    int i, j;
    for (i = 0; i < outputs; i++) y[i] = bias[i];
    for (j = 0; j < inputs; j++)
        for (i = 0; i < outputs; i++) y[i] += weight[j * outputs + i] * x[j];
}}

static float clip(float x, int i)
{{
    return x < low[i] ? low[i] : x > high[i] ? high[i] : x;
}}

static int nearest_to_zero(float *action)
{{
    int i;
    for (i = 0; i < ACTION; i++) action[i] = clip(0.0f, i);
    return 1;
}}

int {name}_act(const float *observation, float *action)
{{
    float x[{size}], y[{size}];
    int i;
    for (i = 0; i < OBSERVATION; i++) {{
        x[i] = observation[i];
        if (!isfinite(x[i])) return nearest_to_zero(action);
    }}
{layers}
    for (i = 0; i < ACTION; i++) {{
        action[i] = center[i] + scale[i] * tanhf(x[i]);
        if (!isfinite(action[i])) return nearest_to_zero(action);
    }}
    return 0;
}}
"""
