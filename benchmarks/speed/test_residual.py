"""The residual as plans call it, against the module, by candidates of one plan and of twenty."""

from __future__ import annotations

import pytest
import torch
from race import race

from phihp_torchrl import load_agent

AGENT = "results/agents/pendulum-swingup"


@pytest.mark.parametrize("rows", [64, 1280])
def test_residual(benchmark, report, rows):
    agent = load_agent(AGENT)
    residual = agent.dynamics.residual
    state = agent.task.coverage.sample([rows])
    action = torch.zeros(rows, 1)
    prepared = residual.prepared()
    assert prepared is not None
    hidden = torch.randn(rows, residual.hidden_sizes[0])
    with torch.no_grad():
        times = race(
            benchmark,
            {
                "prepared": lambda: prepared(state, action),
                "the module": lambda: residual(state, action),
                "a layer's tanh": hidden.tanh,
                "a layer's sigmoid, which stands for it": hidden.sigmoid,
            },
            rounds=300,
        )
    note = f"{rows} rows, hidden layers of {list(residual.hidden_sizes)}."
    ratios = report(f"A residual of {rows} rows", times, note)
    assert ratios["the module"] > 1
