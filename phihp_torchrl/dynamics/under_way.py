"""Transitions that were taken without a word of the actuator, as those of a task that has one."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from phihp_torchrl.tasks import Task


def episodes(data: TensorDictBase) -> list[tuple[int, int]]:
    """Where transitions ``[N]`` in the order of time follow one another, as (begin, end)."""
    ends = (data["next", "done"].flatten()[:-1].nonzero().flatten() + 1).tolist()
    return list(pairwise([0, *ends, len(data)])) if len(data) else []


def with_registers(task: Task, data: TensorDictBase) -> tuple[TensorDict, Tensor]:
    """Append what was under way to the observations of transitions.

    It follows from the commands of each episode, which begins with nothing under way. A stretch
    that begins in the middle of one, which ``"step_count"`` tells, is not known until the actuator
    has forgotten what was before it.

    Args:
        task: the task, with an actuator.
        data: transitions ``[N]`` in the order of time, with the observations of the system alone,
            and ``"done"`` under ``"next"`` at the end of each stretch.

    Returns:
        The transitions ``[N]`` of the task, and which of them are known, bool ``[N]``.

    Examples:
        >>> from dataclasses import replace
        >>> from phihp_torchrl.tasks import Actuator, get_task
        >>> seen, steps = torch.zeros(3, 3), [3]
        >>> following = TensorDict(observation=seen, done=torch.zeros(3, 1).bool(), batch_size=[3])
        >>> parts = {"observation": seen, "action": torch.ones(3, 1), "next": following}
        >>> late = replace(get_task("pendulum"), actuator=Actuator(delay_steps=1.0))
        >>> found, known = with_registers(late, TensorDict(parts, batch_size=[3]))
        >>> found["observation"][:, -1], known.all().item()  # in half-ranges of 2
        (tensor([0.0000, 0.5000, 0.5000]), True)
    """
    assert task.actuator is not None
    spans = episodes(data)
    begin = torch.tensor([a for a, _ in spans])[:, None]
    end = torch.tensor([b for _, b in spans])[:, None]
    index = begin + torch.arange(int((end - begin).max()))
    real = index < end
    commands = data["action"][index.minimum(end - 1)]
    registers = task.rest(commands[:, 0])
    before, after = [], []
    for command in commands.unbind(1):
        before.append(registers)
        registers = task.acting(registers, command)[1]
        after.append(registers)
    known = torch.ones(len(data), dtype=torch.bool)
    if "step_count" in data.keys():  # noqa: SIM118 (a tensordict, no dictionary)
        forgotten = math.ceil(task.actuator.memory(task.time_step) / task.time_step)
        for a, b in spans:
            if data["step_count"][a] > 0:
                known[a : min(a + forgotten, b)] = False
    found = data.clone(recurse=False)
    found["next"] = found["next"].clone(recurse=False)
    for each, rows in ((found, before), (found["next"], after)):
        shown = each["observation"]
        each["observation"] = task.complete(shown, torch.stack(rows, 1)[real])
    return found, known
