"""Control a plant that keeps its own time behind a UDP socket, and count what came too late.

    python recipes/socket_loop.py results/agents/pendulum-swingup --rates 50 200

The plant is the task's simulated world, in a process of its own. At each tick it moves by the last
command that has come and sends a sample. The agent has three quarters of a tick to answer.
"""

from __future__ import annotations

import argparse
import multiprocessing
import socket
import struct
import time
from dataclasses import replace

import torch

from phihp_torchrl.deployment import Controller, Safety, load_agent
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.tasks import get_task
from phihp_torchrl.worlds import SimulatedWorld


def serve(name: str, rate: float, ticks: int, to: tuple[str, int]) -> None:
    """Be the plant: send ``(tick, ticks missed so far, time, *observation)``, at last nothing."""
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
                    answered, *command = struct.unpack(f"=i{task.action_dim}f", line.recv(1024))
                    action = torch.tensor(command)
            except BlockingIOError:
                missed += int(answered < tick - 1)
            with torch.no_grad():
                state = world.transition(state, action)[0]
            seen = world.observe(state)[: task.system.observation_dim].tolist()
            line.sendto(struct.pack(f"=iid{len(seen)}f", tick, missed, time.monotonic(), *seen), to)
        line.sendto(b"", to)


def control(controller: Controller, line: socket.socket) -> tuple[int, int]:
    """Answer each sample with an action, to the end; the plant's ticks and how many it missed."""
    tick, missed = -1, 0
    controller.reset()
    while (heard := line.recvfrom(1024))[0]:
        floats = (len(heard[0]) - 16) // 4
        tick, missed, stamp, *seen = struct.unpack(f"=iid{floats}f", heard[0])
        action = controller.step(seen, timestamp=stamp)
        line.sendto(struct.pack(f"=i{len(action)}f", tick, *action), heard[1])
    return tick + 1, missed


def play(controller: Controller, rate: float, seconds: float) -> tuple[int, int]:
    """Start a plant, control it, and return its ticks and how many it missed."""
    with socket.socket(type=socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        line.settimeout(60.0)  # a process needs a while to start
        arguments = (controller.task.name, rate, round(rate * seconds), line.getsockname())
        plant = multiprocessing.get_context("spawn").Process(target=serve, args=arguments)
        plant.start()
        try:
            return control(controller, line)
        finally:
            plant.join(5.0)
            plant.kill()


def main() -> None:
    """Play at each rate, by the plan and by the actor alone, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("agent", help="directory of a saved agent")
    parser.add_argument("--rates", nargs="+", type=float, default=[50.0, 200.0], help="in Hz")
    parser.add_argument("--seconds", type=float, default=10.0, help="at each rate")
    parser.add_argument("--compile", action="store_true", help="compile the plan")
    words, rows = parser.parse_args(), []
    torch.set_num_threads(1)
    for name, plans in (("plan", True), ("actor", False)):
        agent = load_agent(words.agent, planner=plans, compile=plans and words.compile)
        for rate in words.rates:
            safety = Safety(deadline=0.75 / rate, max_age=0.75 / rate)
            controller = Controller(agent, safety=safety, clock=time.monotonic)
            controller.warm_up()
            ticks, missed = play(controller, rate, words.seconds)
            rows.append([name, f"{rate:g}", f"{missed} of {ticks}", str(controller.report())])
            controller.close()
    print(markdown_table(["agent", "Hz", "missed", "controller"], rows))


if __name__ == "__main__":
    main()
