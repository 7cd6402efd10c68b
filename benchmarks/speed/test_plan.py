"""A plan at the published budget, against five peers."""

from __future__ import annotations

from dataclasses import replace

import pytest
from race import forward, products, race
from tensordict import TensorDict
from torchrl.modules import CEMPlanner as StockCEMPlanner

from phihp_torchrl import CEMPlanner, WorldModelEnv, load_agent, load_config
from phihp_torchrl.config import read_kind
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.planners import PLANNERS, make_planner
from phihp_torchrl.tdmpc import TOLD, make_latent_planner
from phihp_torchrl.trainers import read_run_config

AGENT = "results/agents/pendulum-swingup"
# The published settings of PendulumSwingup.
TASK = "pendulum-swingup"
PUBLISHED = read_kind(PLANNERS, load_config(TASK, preset="paper")["planner"], "planner")


def published_tdmpc():
    """TD-MPC's settings as published, networks and planner among them."""
    settings = load_config(TASK, method="td-mpc", preset="paper")
    return read_run_config(settings).section("tdmpc")


def tail_products(config, agent):
    """Products of actor and critics beyond the horizon, of all iterations."""
    actor = [agent.actor.module.mlp[0].in_features, 300, 300, 1]
    critic = [actor[0] + 1, 200, 200, 200, 1]
    once = forward(config.num_candidates, actor) + 2 * forward(config.num_candidates, critic)
    return config.optim_steps * once


@pytest.mark.timeout(1800)  # four plans are compiled
def test_published_budget(benchmark, report):
    agent = load_agent(AGENT)
    model = TaskWorldModel(agent.task, agent.dynamics)
    observation = agent.task.observe(agent.task.reset.sample([]))
    data = TensorDict(observation=observation)

    def planner(config=PUBLISHED, **options):
        return make_planner(model, agent.actor, agent.qvalue, config, **options)

    def acts(module):
        return lambda: module(data.clone())

    env = WorldModelEnv(model, seed=0)
    stepped = CEMPlanner.from_config(
        env, PUBLISHED, actor=agent.actor, qvalue=agent.qvalue, backend="env"
    )
    # TorchRL's own, on an environment of its sequences' shape.
    stock_env = WorldModelEnv(model, seed=0)
    stock = StockCEMPlanner(stock_env, 5, 3, 220, 10)
    state = env.reset(data.clone().set("observation", observation))
    tdmpc = published_tdmpc()
    told = TOLD.for_task(agent.task, tdmpc.learn.told)  # untrained: only its time is of interest
    encoded = TensorDict(latent=told.encode(observation).detach())
    published_mppi = tdmpc.planner.at(tdmpc.planner.schedule_steps)
    mppi, compiled_mppi = (
        make_latent_planner(told, published_mppi, compile=compile) for compile in (False, True)
    )
    reduced = replace(PUBLISHED, tail_dtype="bfloat16")
    times = race(
        benchmark,
        {
            "plan, compiled": acts(planner(compile=True)),
            "plan, compiled, tail in bfloat16": acts(planner(reduced, compile=True)),
            "plan, eager on tensors": acts(planner()),
            "(a) the same plan by env.step": acts(stepped),
            "(b) TorchRL's CEMPlanner, no actor, no Q": lambda: stock(state.clone()),
            "(c) TD-MPC's MPPI, eager": lambda: mppi(encoded.clone()),
            "(c) TD-MPC's MPPI, compiled": lambda: compiled_mppi(encoded.clone()),
            "(d) the actor alone": acts(agent.actor_alone()),
            "(e) products of the plan's tail": products(tail_products(PUBLISHED, agent)),
        },
        rounds=30,
    )
    note = (
        "PendulumSwingup, 220 candidates, 3 iterations, horizon 5, one plan at a time. (e) is "
        "`torch.mm` on the shapes that actor and critics meet beyond the horizon, nothing else; "
        "compiled graphs ask oneDNN for those that it does faster on this machine."
    )
    ratios = report("A plan at the published budget", times, note)
    assert ratios["(a) the same plan by env.step"] > 1
