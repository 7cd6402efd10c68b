"""The fused TD3 step against TorchRL's parts and against its arithmetic."""

from __future__ import annotations

import pytest
import torch
from race import backward, forward, layers_of, products, race
from stock_td3 import StockTD3Update

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import TD3Config, TD3Update, make_td3_loss
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.imagination import Batch

ACTOR, CRITIC = [3, 300, 300, 1], [4, 200, 200, 200, 1]


def step_products(rows):
    """Products of two critic updates and one of the actor, as TD3 prescribes them."""
    targets = forward(2 * rows, ACTOR) + 2 * forward(2 * rows, CRITIC)
    critics = 2 * (2 * (forward(rows, CRITIC) + backward(rows, CRITIC)))
    actor = forward(rows, ACTOR) + backward(rows, ACTOR)
    through_q = forward(rows, CRITIC) + backward(rows, CRITIC, weights=False)
    return targets + critics + actor + through_q


def adam_passes():
    """Adam, torch's fused one, over the critics twice and over the actor once."""
    actor, critics = (
        [torch.randn(n, requires_grad=True)] for n in (parameters(ACTOR), 2 * parameters(CRITIC))
    )
    for tensor in (*actor, *critics):
        tensor.grad = torch.randn_like(tensor)
    of_actor, of_critics = (torch.optim.Adam(group, fused=True) for group in (actor, critics))
    return lambda: (of_critics.step(), of_critics.step(), of_actor.step())


def parameters(sizes):
    return sum(i * o + o for i, o in layers_of(sizes))


@pytest.mark.parametrize("rows", [64, 128])
def test_update(benchmark, report, rows):
    task, config = get_task("pendulum-swingup"), TD3Config()
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    state = task.coverage.sample([2 * rows])
    action = 4 * torch.rand(2 * rows, 1) - 2
    with torch.no_grad():
        batch = Batch(state, action, *_reordered(model.transition(state, action)))
    fused = TD3Update(make_td3_loss(model, config), model, config, compile=True)
    eager = TD3Update(make_td3_loss(model, config), model, config)
    gemms, adam = products(step_products(rows)), adam_passes()

    def stock(fused_adam):
        return StockTD3Update(make_td3_loss(model, config), model, config, fused=fused_adam)

    def trains(update):
        def call():
            with torch.enable_grad():
                update(batch)

        return call

    times = race(
        benchmark,
        {
            "fused step, compiled": lambda: fused(batch),
            "fused step, eager": lambda: eager(batch),
            "TorchRL's TD3Loss, Adam, SoftUpdate": trains(stock(False)),
            "the same, torch's fused Adam": trains(stock(True)),
            "its products and passes of Adam": lambda: (gemms(), adam()),
        },
        rounds=60,
    )
    note = (
        f"Published networks, batch {rows}; the time is for one critic update, with half an update "
        "of the actor and of the targets. The last row is `torch.mm` on the shapes of all products "
        "and torch's fused Adam over all parameters, nothing else."
    )
    report(f"A TD3 update of {rows} transitions", times, note, work=config.policy_delay)


def _reordered(transition):
    next_state, reward, terminated = transition
    return reward, next_state, terminated
