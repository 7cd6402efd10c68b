"""A simulated plant behind a UDP socket, which keeps its own time and waits for nobody."""

from __future__ import annotations

import multiprocessing
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import torch

from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.tasks import get_task
from phihp_torchrl.worlds import SimulatedWorld

SAMPLE = "=iid"
"""A sample begins with its tick, the ticks missed so far and its time; floats measured follow."""
COMMAND = "=i"
"""A command begins with the tick that it answers; the floats of the action follow."""


def serve(name: str, rate: float, ticks: int, to: tuple[str, int]) -> None:
    """Be the plant: at each tick move by the last command that has come, and send a sample.

    A tick is missed where no new command has come since the one before. The last packet is empty.

    Args:
        name: name of the task, whose simulated world is stepped.
        rate: ticks per second.
        ticks: number of ticks.
        to: address of the controller.
    """
    torch.set_num_threads(1)
    task = replace(get_task(name), time_step=1.0 / rate)
    world = TaskWorldModel(task, SimulatedWorld(task).oracle())
    state, action = task.sample_start([], torch.Generator().manual_seed(0)), task.bounds.center
    missed, due = 0, time.monotonic() + 0.1
    with socket.socket(type=socket.SOCK_DGRAM) as line:
        line.setblocking(False)
        for tick in range(ticks):
            time.sleep(max(0.0, due - time.monotonic()))
            due, answered = due + 1.0 / rate, -1
            try:
                while True:  # until all that has come is read; the newest counts
                    packet = f"{COMMAND}{task.action_dim}f"
                    answered, *command = struct.unpack(packet, line.recv(1024))
                    action = torch.tensor(command)
            except BlockingIOError:
                missed += int(answered < tick - 1)
            with torch.no_grad():
                state = world.transition(state, action)[0]
            seen = world.observe(state)[: task.system.observation_dim].tolist()
            now = time.monotonic()
            line.sendto(struct.pack(f"{SAMPLE}{len(seen)}f", tick, missed, now, *seen), to)
        line.sendto(b"", to)


@contextmanager
def simulated_plant(name: str, rate: float, seconds: float) -> Iterator[socket.socket]:
    """Start a plant in a process of its own, and give the socket on which its samples come.

    Each packet is ``(tick, ticks missed so far, time, *observation)``, as
    ``struct.unpack("=iid" + f"{o}f", packet)`` reads it; its time is that of
    :func:`time.monotonic`. An answer to its sender is ``(tick, *action)``, ``"=i" + f"{m}f"``. The
    last packet is empty. The process ends with the context.

    Args:
        name: name of a registered task of the package.
        rate: ticks per second.
        seconds: how long it runs.
    """
    with socket.socket(type=socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        line.settimeout(60.0)  # a process needs a while to start
        arguments = (name, rate, round(rate * seconds), line.getsockname())
        plant = multiprocessing.get_context("spawn").Process(target=serve, args=arguments)
        plant.start()
        try:
            yield line
        finally:
            plant.join(5.0)
            plant.kill()
