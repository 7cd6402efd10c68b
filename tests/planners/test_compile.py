"""Compiled plans are the eager ones, each one graph; what does not compile says so."""

from __future__ import annotations

import logging

import pytest
import torch
from points import ZEROS, point_problem
from tensordict import TensorDict
from torch import nn
from torchrl.envs import PendulumEnv

from phihp_torchrl import WorldModelEnv
from phihp_torchrl.planners import cem_plan
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

from .cem_parts import draw, flat_value, settings
from .planner_parts import make_planner, noise_for, task_parts


def test_plans_compile_as_one_graph():
    graphs = []

    def backend(graph, _):
        graphs.append(graph)
        return graph.forward

    torch._dynamo.reset()
    actor = nn.Linear(2, 2, dtype=torch.float64)
    s = settings(num_policy_candidates=10, num_kept_elites=2)
    problem = point_problem(actor, flat_value, wall=1.4)

    def function(observation, noise):
        return cem_plan(observation, noise, problem=problem, settings=s)

    compiled = torch.compile(function, fullgraph=True, backend=backend)
    with torch.no_grad():
        for seed in range(3):
            actor.weight.add_(0.1)  # refreshed in place, as training does
            noise = draw(s, seed=seed)
            torch.testing.assert_close(compiled(ZEROS, noise), function(ZEROS, noise))
    assert len(graphs) == 1


@pytest.mark.parametrize("horizon", [2, 12])  # written out, and as a loop
def test_compiled_equals_eager(horizon):
    torch._dynamo.reset()
    task, env, actor, qvalue = task_parts("cartpole")
    eager, compiled = (
        make_planner(env, actor, qvalue, planning_horizon=horizon, change_cost=0.1, compile=c)
        for c in (False, {"backend": "eager"})
    )
    for seed in range(2):
        state = task.coverage.sample([3])
        tensordict = TensorDict(observation=task.observe(state), batch_size=[3])
        noise = noise_for(eager, (3,), seed)
        torch.testing.assert_close(*(p.plan(tensordict, noise) for p in (eager, compiled)))
    assert compiled.problem(compiled=True).in_loop is (horizon == 12)


def test_what_cannot_compile_says_so(caplog):
    with caplog.at_level(logging.INFO, logger="phihp_torchrl"):
        make_planner(PendulumEnv(), compile=True)
    assert caplog.records[0].levelname == "WARNING"
    assert "which is not compiled" in caplog.records[0].getMessage()
    model = SimulatedWorld("pendulum", SimulatedConfig(integrator="dopri5")).model()
    planner = make_planner(WorldModelEnv(model), compile=True)
    assert "integrator does not compile" in caplog.records[1].getMessage()
    assert planner.plan(TensorDict(observation=torch.tensor([1.0, 0.0, 0.0]))).score.isfinite()
