"""Control a plant that keeps its own time behind a UDP socket, and count what came too late.

    python recipes/socket_loop.py results/agents/pendulum-swingup --rates 50 200

The plant is the task's simulated world, in a process of its own. At each tick it moves by the last
command that has come and sends a sample. The agent has three quarters of a tick to answer.
"""

from __future__ import annotations

import argparse
import socket
import struct
import time

import torch

from phihp_torchrl.deployment import Controller, Safety, load_agent, simulated_plant
from phihp_torchrl.evaluation import markdown_table


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
            with simulated_plant(agent.task.name, rate, words.seconds) as line:
                ticks, missed = control(controller, line)
            rows.append([name, f"{rate:g}", f"{missed} of {ticks}", str(controller.report())])
            controller.close()
    print(markdown_table(["agent", "Hz", "missed", "controller"], rows))


if __name__ == "__main__":
    main()
