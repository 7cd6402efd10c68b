"""What a user would pick instead, timed in turn in one process, and how time and memory grow.

    python benchmarks/speed/side_by_side.py
    python benchmarks/speed/side_by_side.py --parts plan growth --compile=false

Contenders: TorchRL's TD3Loss and CEMPlanner, Stable-Baselines3's TD3, pytorch-mppi, the planner of
TD-MPC as this package has it, and the products of matrices that each hot path cannot do without.
Peers that are not installed are named and left out; they need no torch of their own:

    pip install --no-deps --target PEERS stable-baselines3 pytorch-mppi arm-pytorch-utilities \
        pytorch-seed cloudpickle
    PYTHONPATH=PEERS python benchmarks/speed/side_by_side.py

Each part replaces its own entry of results/speed/side_by_side.json; README.md there shows them all.
Times are those of the one thread, without what it waited for.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from race import backward, figures, forward, products
from stock_td3 import StockTD3Update
from tensordict import TensorDict
from torchrl.modules import CEMPlanner as StockCEMPlanner

from phihp_torchrl import (
    Box,
    HybridDynamics,
    System,
    Task,
    WorldModelEnv,
    get_task,
    load_agent,
    load_config,
)
from phihp_torchrl.agents import TD3Config, TD3Update, make_actor, make_td3_loss, make_twin_qvalue
from phihp_torchrl.config import read_kind
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.evaluation import markdown_table
from phihp_torchrl.imagination import Batch
from phihp_torchrl.origin import describe_origin, origin_text
from phihp_torchrl.planners import PLANNERS, CEMConfig, MPPIConfig, make_planner
from phihp_torchrl.tdmpc import TOLD, make_latent_planner

TASK = "pendulum-swingup"
AGENT = f"results/agents/{TASK}"
RESULTS = Path("results/speed")
PUBLISHED = read_kind(PLANNERS, load_config(TASK, preset="paper")["planner"], "planner")
SAMPLES = PUBLISHED.optim_steps * PUBLISHED.num_candidates
ACTOR, CRITIC, ROWS = [3, 300, 300, 1], [4, 200, 200, 200, 1], 128

Call = Callable[[], Any]


def interleaved(contenders: dict[str, Call], rounds: int) -> list[dict[str, Any]]:
    """Median milliseconds of each contender, and the median of its ratio to the first's."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for call in contenders.values():
        call()
    for _ in range(rounds):
        for name, call in contenders.items():
            start = time.thread_time()
            call()
            times[name].append(1e3 * (time.thread_time() - start))
    return figures(times)


def plan_part(compiled: bool) -> dict[str, Any]:
    """One plan, and one action, of the shipped agent and of what could stand in its place."""
    agent = load_agent(AGENT)
    task, model = agent.task, TaskWorldModel(agent.task, agent.dynamics)
    observation = task.observe(task.reset.sample([]))
    data = TensorDict(observation=observation)

    def acts(module: Any, given: TensorDict = data) -> Call:
        return lambda: module(given.clone())

    def planner(config: Any = PUBLISHED, **options: Any) -> Any:
        return make_planner(model, agent.actor, agent.qvalue, config, **options)

    published, env = planner(), WorldModelEnv(model, seed=0)
    noise = torch.randn(PUBLISHED.noise_shape((), 1))

    def by_the_model() -> Any:
        return published._plan(observation, noise, problem=published.problem(), settings=PUBLISHED)

    stock = StockCEMPlanner(
        env,
        PUBLISHED.planning_horizon,
        PUBLISHED.optim_steps,
        PUBLISHED.num_candidates,
        PUBLISHED.top_k,
    )
    state = env.reset(data.clone())
    told = TOLD.for_task(task)  # untrained: only its time is of interest
    encoded = TensorDict(latent=told.encode(observation).detach())
    numbers = {"num_candidates": PUBLISHED.num_candidates, "optim_steps": PUBLISHED.optim_steps}
    latent = MPPIConfig(planning_horizon=PUBLISHED.planning_horizon, **numbers)
    rows = PUBLISHED.num_candidates
    tail = forward(rows, ACTOR) + 2 * forward(rows, CRITIC)
    contenders = {
        "load_agent, as it comes: a plan": acts(agent),
        "the published budget, eager": acts(published),
        "the same, calling the model's functions step by step": by_the_model,
        "TorchRL's CEMPlanner, no actor, no Q": lambda: stock(state.clone()),
        "TD-MPC's planner (TOLD, MPPI), eager": acts(make_latent_planner(told, latent), encoded),
        "products of the published plan's tail": products(PUBLISHED.optim_steps * tail),
        "the actor alone": acts(agent.actor_alone()),
        "products of the actor": products(forward(1, ACTOR)),
    }
    if (other := mppi_of_others(model, observation)) is not None:
        contenders["pytorch-mppi, no actor, no Q"] = other
    if compiled:
        contenders["load_agent, compiled: a plan"] = acts(load_agent(AGENT, compile=True))
        contenders["the published budget, compiled"] = acts(planner(compile=True))
    note = (
        f"PendulumSwingup, one plan at a time, {SAMPLES} sequences of "
        f"{PUBLISHED.planning_horizon} steps each, but for the agent, which comes with its own "
        f"budget ({agent.planner_config.optim_steps} x {agent.planner_config.num_candidates})."
    )
    with torch.no_grad():
        return {"note": note, "rows": interleaved(contenders, rounds=30)}


def mppi_of_others(model: TaskWorldModel, observation: torch.Tensor) -> Call | None:
    """A plan by pytorch-mppi with as many samples in the same model; ``None`` without it."""
    try:
        from pytorch_mppi import MPPI
    except ImportError as error:
        print(f"pytorch-mppi is left out: {error}")
        return None
    state = model.locate(observation)

    def cost(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return -model.task.reward(states, actions, states)

    def step(states: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return model.transitions.step(states, actions)

    high = torch.tensor(model.task.action_high)
    search = MPPI(
        step,
        cost,
        len(state),
        torch.eye(1),
        num_samples=SAMPLES,
        horizon=PUBLISHED.planning_horizon,
        u_min=-high,
        u_max=high,
    )
    return lambda: search.command(state)


def td3_part(compiled: bool) -> dict[str, Any]:
    """Two updates of the critics and one of the actor, on batches of 128."""
    task, config = get_task(TASK), TD3Config()
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    state = task.coverage.sample([2 * ROWS])
    action = 4 * torch.rand(2 * ROWS, 1) - 2
    with torch.no_grad():
        found = model.transition(state, action)
    batch = Batch(state, action, found.reward, found.next_state, found.terminated)
    gemms = (
        forward(2 * ROWS, ACTOR)
        + 2 * forward(2 * ROWS, CRITIC)
        + 4 * (forward(ROWS, CRITIC) + backward(ROWS, CRITIC))
        + forward(ROWS, ACTOR)
        + backward(ROWS, ACTOR)
        + forward(ROWS, CRITIC)
        + backward(ROWS, CRITIC, weights=False)
    )

    def ours(compile: bool) -> Call:
        update = TD3Update(make_td3_loss(model, config), model, config, compile=compile)
        return lambda: update(batch)

    stock = StockTD3Update(make_td3_loss(model, config), model, config, fused=True)
    contenders = {
        **({"this package's step, compiled": ours(True)} if compiled else {}),
        "this package's step, eager": ours(False),
        "TorchRL's TD3Loss, fused Adam, SoftUpdate": lambda: stock(batch),
        "its products": products(gemms),
    }
    if (other := td3_of_others()) is not None:
        contenders["Stable-Baselines3's TD3.train, with its replay buffer"] = other
    note = f"Published networks, {ROWS} transitions; a call is two updates of the critics."
    return {"note": note, "rows": interleaved(contenders, rounds=30)}


def td3_of_others() -> Call | None:
    """Two gradient steps of Stable-Baselines3; ``None`` without it."""
    try:
        from stable_baselines3 import TD3
        from stable_baselines3.common.logger import configure
    except ImportError as error:
        print(f"Stable-Baselines3 is left out: {error}")
        return None
    networks = {"net_arch": {"pi": ACTOR[1:-1], "qf": CRITIC[1:-1]}}
    learner = TD3(
        "MlpPolicy",
        "Pendulum-v1",
        policy_kwargs=networks,
        learning_starts=1000,
        device="cpu",
        buffer_size=5000,
        train_freq=2000,
    )
    learner.set_logger(configure(None, []))
    learner.learn(1000)  # fills the buffer, and trains nothing
    return lambda: learner.train(gradient_steps=2, batch_size=ROWS)


class Masses(System):
    """As many masses on springs as make up a state, for growth with its size."""

    action_names = ("force",)
    default_constants = {"mass": 1.0, "stiffness": 2.0}

    def prior(self, state: torch.Tensor, action: torch.Tensor, constants: Any) -> torch.Tensor:
        half = self.state_dim // 2
        pull = action - constants["stiffness"] * state[..., :half]
        return torch.cat([state[..., half:], pull / constants["mass"]], -1)


def masses(size: int) -> Task:
    half = size // 2
    names = [f"x{i}" for i in range(half)], [f"v{i}" for i in range(half)]
    fields = {"state_names": (*names[0], *names[1]), "velocity_of": dict(zip(*names, strict=True))}
    system = type(f"Masses{size}", (Masses,), fields)()
    return Task(
        name=f"masses-{size}",
        system=system,
        action_high=(1.0,),
        time_step=0.05,
        max_steps=200,
        reset=Box.around((0.0,) * size, (1.0,) * size),
        reward=lambda state, action, next_state: -next_state.square().sum(-1),
    )


def growth_part(compiled: bool) -> dict[str, Any]:
    """An eager plan as one of its sizes grows and the others stay."""
    base = CEMConfig(planning_horizon=10, num_candidates=128)

    def plans(task: Task, config: CEMConfig = base, batch: int = 1) -> Call:
        model = TaskWorldModel(task, HybridDynamics.hybrid(task))
        planner = make_planner(model, make_actor(task), make_twin_qvalue(task), config)
        data = TensorDict(observation=task.observe(task.reset.sample([batch])), batch_size=[batch])
        return lambda: planner(data.clone())

    four = masses(4)
    series: dict[str, dict[Any, Call]] = {
        "state size": {n: plans(masses(n)) for n in (2, 4, 8, 16)},
        "horizon": {h: plans(four, replace(base, planning_horizon=h)) for h in (5, 10, 20, 40)},
        "candidates": {
            n: plans(four, replace(base, num_candidates=n)) for n in (64, 128, 256, 512)
        },
        "plans in a batch": {n: plans(four, batch=n) for n in (1, 4, 16)},
    }
    rows = []
    with torch.no_grad():
        for name, calls in series.items():
            found = interleaved({f"{name} {n}": call for n, call in calls.items()}, rounds=5)
            rows += found
    note = (
        "Masses on springs: state of 4, horizon 10, 128 candidates, 2 iterations, one plan, unless "
        "the row says otherwise; eager, published networks. Ratios are to the first of a series."
    )
    return {"note": note, "rows": rows}


_MEMORY = {
    "torch and this package imported": "",
    "and an agent that plans eagerly": "act(load_agent(AGENT, packaged=False))",
    "and one that is compiled": "act(load_agent(AGENT, compile=True))",
}


def memory_part(compiled: bool) -> dict[str, Any]:
    """Peak of resident memory, each in a process of its own."""
    start = (
        "import torch; from tensordict import TensorDict; torch.set_num_threads(1)\n"
        f"from phihp_torchrl import load_agent; AGENT = {AGENT!r}\n"
        "def act(agent):\n"
        "    seen = agent.task.observe(agent.task.reset.sample([]))\n"
        "    for _ in range(20): agent(TensorDict(observation=seen))\n"
    )
    # Not getrusage, whose peak of a child begins with that of its parent.
    end = (
        "\nlines = open('/proc/self/status').read().splitlines()"
        "\nprint(next(line for line in lines if line.startswith('VmHWM')).split()[1])"
    )
    rows = []
    for name, code in _MEMORY.items():
        if "compile" in code and not compiled:
            continue
        out = subprocess.run(
            [sys.executable, "-c", start + code + end], capture_output=True, text=True, check=True
        )
        rows.append({"contender": name, "MB": int(out.stdout.split()[-1]) / 1024})
    return {"note": "Peak of resident memory of a process.", "rows": rows}


PARTS = {"plan": plan_part, "td3": td3_part, "growth": growth_part, "memory": memory_part}
TITLES = {
    "plan": "A plan, an action",
    "td3": "TD3",
    "growth": "How a plan's time grows",
    "memory": "Memory",
}


def write(record: dict[str, Any]) -> None:
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / "side_by_side.json").write_text(json.dumps(record, indent=2) + "\n")
    text = (
        "# Side by side\n\nMade by `python benchmarks/speed/side_by_side.py`. Contenders take "
        "turns in one process; *ms* is the median of a call, *ratio* the median of a call's time "
        "to that of the first row in the same round. Times are those of the one thread.\n"
    )
    for name, part in record.items():
        header = list(part["rows"][0])
        cells = [
            [value if isinstance(value, str) else f"{value:.3g}" for value in row.values()]
            for row in part["rows"]
        ]
        text += f"\n## {TITLES[name]}\n\n{part['note']}\n\n{markdown_table(header, cells)}\n"
        text += f"\n{part['machine']}\n"
    (RESULTS / "README.md").write_text(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--compile", choices=("true", "false"), default="true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    place = RESULTS / "side_by_side.json"
    record = json.loads(place.read_text()) if place.is_file() else {}
    for name in given.parts:
        torch.manual_seed(0)
        started = time.perf_counter()
        part = PARTS[name](given.compile == "true")
        origin = describe_origin(seed=0)
        load = os.getloadavg()[0]
        part["machine"] = f"{origin_text(origin)}, load {load:.1f}, torch {torch.__version__}."
        record = {
            key: part if key == name else record[key]
            for key in PARTS
            if key == name or key in record
        }
        write(record)
        print(f"{name}: {time.perf_counter() - started:.0f} s")
        for row in part["rows"]:
            print("   ", row)


if __name__ == "__main__":
    main()
