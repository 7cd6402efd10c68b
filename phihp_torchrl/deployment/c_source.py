"""An actor as one file of C99, for a controller without Python: float32, libm, and no more."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import torch
from torch import Tensor, nn

from phihp_torchrl.agents import Actor
from phihp_torchrl.config import ConfigError
from phihp_torchrl.deployment.c_actuator import actuator_source
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
    to zero. Where the task has an actuator, there are besides a struct
    ``NAME_memory`` of what is under way, ``NAME_reset``, ``NAME_step``, which takes the observation
    of the system alone, and ``NAME_sent``, which is told a command that was sent in its place.
    ``cc -DNAME_MAIN`` makes a program that reads observations and writes actions, line by line.

    Args:
        module: the actor, a network of linear layers with ReLU, tanh or SiLU.
        path: the file to write, ending in ``.c``.

    Returns:
        The path.

    Raises:
        ConfigError: for an actor of another make, and for a task that adds anything else to its
            state than an actuator.

    Examples:
        >>> import tempfile
        >>> from phihp_torchrl import Agent, get_task
        >>> task = get_task("pendulum")
        >>> module = ActorModule(Agent(task, actor=Actor(task, (8,))))
        >>> with tempfile.TemporaryDirectory() as place:
        ...     text = export_c(module, f"{place}/swing.c").read_text()
        >>> "int swing_act(const float *observation, float *action)" in text
        True
    """
    path, task, actor = Path(path), module.task, module.network
    name = path.stem
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ConfigError("path", f"expected a name of a C function before .c, got {name!r}.")
    if not isinstance(actor, Actor):
        raise ConfigError("agent", f"expected an Actor for C, got a {type(actor).__name__}.")
    actuator = task.actuator
    if task.register_count != (0 if actuator is None else actuator.registers(task.action_dim)):
        raise ConfigError(
            "agent",
            "expected a task that adds to its state an actuator at most, for C; export the actor "
            "as ONNX, and keep the rest of the state in a Controller.",
        )
    bounds = task.bounds
    tables = {"low": bounds.low, "high": bounds.high, "center": bounds.center}
    parts = [_HEAD.format(name=name, task=task.name, NAME=name.upper())]
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
    if task.register_count:
        parts.append(actuator_source(name, task))
    main = _MAIN_STEP if task.register_count else _MAIN_ACT
    size = task.system.observation_dim
    parts.append(main.format(name=name, NAME=name.upper(), size=size))
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


def table(name: str, values: Tensor | Iterable[float]) -> str:
    """A constant array of floats, each as it is to the bit."""
    flat = torch.as_tensor(values, dtype=torch.float32).detach().cpu().flatten().tolist()
    words = [f"{each:.9g}" for each in flat]
    words = [word if any(c in word for c in ".e") else f"{word}.0" for word in words]
    lines = [", ".join(f"{w}f" for w in words[i : i + 8]) for i in range(0, len(words), 8)]
    return f"static const float {name}[] = {{\n    " + ",\n    ".join(lines) + "\n};\n"


_HEAD = """\
/* The actor of an agent for the task {task}: observation in, action out, in physical units.
 *
 *   int {name}_act(const float *observation, float *action);
 *
 * It returns 0, or 1 where a number is not finite; the action is then the one nearest to zero.
 * Compile without -ffast-math:  cc -O3 -std=c99 -c {name}.c   (link with -lm)
 * As a program that reads observations and writes actions:  cc -O3 -D{NAME}_MAIN {name}.c -lm
 */
#include <math.h>
"""

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

_MAIN_ACT = """\
#ifdef {NAME}_MAIN
#include <stdio.h>
int main(void)
{{
    float observation[{size}], action[ACTION];
    int i = 0;
    while (scanf("%f", &observation[i]) == 1) {{
        if (++i < {size}) continue;
        {name}_act(observation, action);
        for (i = 0; i < ACTION; i++) printf("%.9g%c", action[i], i < ACTION - 1 ? ' ' : '\\n');
        fflush(stdout);
        i = 0;
    }}
    return 0;
}}
#endif
"""

_START = "int i = 0;\n    {name}_memory memory;\n    {name}_reset(&memory);\n"
_MAIN_STEP = _MAIN_ACT.replace("int i = 0;\n", _START, 1).replace(
    "{name}_act(observation", "{name}_step(&memory, observation"
)
