"""Actors that are exported as C and compiled, with every warning an error."""

from __future__ import annotations

import ctypes
import shutil
import subprocess

import pytest
import torch

from phihp_torchrl import Agent
from phihp_torchrl.agents import Actor
from phihp_torchrl.deployment import ActorModule, export_c

CC = shutil.which("cc")
needs_cc = pytest.mark.skipif(CC is None, reason="there is no C compiler, cc")


def lively(task, widths=(16, 12)):
    """An agent whose actions differ and reach the bounds."""
    torch.manual_seed(0)
    actor = Actor(task, widths)
    with torch.no_grad():
        actor.mlp[-1].weight.mul_(8.0)
    return Agent(task, actor=actor)


def compile_c(source, target, *flags):
    words = [CC, "-O2", "-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", *flags]
    subprocess.run(
        [*map(str, words), str(source), "-o", str(target), "-lm"], check=True, timeout=120
    )
    return target


def ask(source, lines):
    """Compile a source as its program, and ask it for an action a line."""
    program = compile_c(source, source.with_suffix(""), f"-D{source.stem.upper()}_MAIN")
    text = "".join(f"{line}\n" for line in lines)
    done = subprocess.run(
        [str(program)], input=text, capture_output=True, text=True, timeout=60, check=True
    )
    return torch.tensor([[float(w) for w in line.split()] for line in done.stdout.splitlines()])


def words(values):
    """Numbers, each as it is to the bit; nothing is a NULL pointer."""
    return "-" if values is None else " ".join(f"{x:.9g}" for x in values.flatten().tolist())


class Compiled:
    """The functions of an exported actor of a task with registers, and a memory."""

    def __init__(self, agent, place):
        source = export_c(ActorModule(agent), place / "actor.c")
        self.library = ctypes.CDLL(str(compile_c(source, place / "actor.so", "-shared", "-fPIC")))
        self.task = agent.task
        self.memory = ctypes.create_string_buffer(4096)
        self.reset()

    def reset(self):
        self.library.actor_reset(self.memory)

    def step(self, observation, **given):
        """What the function returns, and the action ``[m]``."""
        action = torch.full([self.task.action_dim], torch.nan)
        signals = [given.get(key) for key in self.task.outside.signals]
        arrays = [each if each is None else each.contiguous() for each in (observation, *signals)]
        pointers = [pointer(each) for each in (*arrays, action)]
        return self.library.actor_step(self.memory, *pointers), action

    def sent(self, command):
        self.library.actor_sent(self.memory, pointer(command))


def pointer(tensor):
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())
