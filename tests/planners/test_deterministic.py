"""Plans in several threads leave TorchRL's exploration type as they found it."""

from __future__ import annotations

import threading

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from phihp_torchrl import HybridDynamics, TaskWorldModel, get_task
from phihp_torchrl.planners import CEMConfig, make_planner
from phihp_torchrl.planners.deterministic import deterministic

TASK = get_task("pendulum")


@pytest.mark.parametrize("kind", list(ExplorationType))
def test_contexts_of_threads_that_overlap_restore_the_type(kind: ExplorationType) -> None:
    """Each thread leaves after the next one has entered, the order in which stock contexts leak."""
    entered, left = [threading.Event() for _ in range(4)], [threading.Event() for _ in range(4)]
    seen = []

    def act(i: int) -> None:
        if i:
            entered[i - 1].wait(10)
        with deterministic():
            entered[i].set()
            if i < 3:
                entered[i + 1].wait(10)
            seen.append(exploration_type())
        left[i].set()

    with set_exploration_type(kind):
        threads = [threading.Thread(target=act, args=(i,)) for i in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(20)
        assert exploration_type() is kind
    assert seen == [ExplorationType.DETERMINISTIC] * 4


def test_an_error_restores_it_too() -> None:
    before = exploration_type()
    with pytest.raises(RuntimeError), deterministic():
        raise RuntimeError
    assert exploration_type() is before


def test_planners_in_threads_plan_as_alone_and_leave_it() -> None:
    settings = CEMConfig(
        planning_horizon=3, num_candidates=16, top_k=4, optim_steps=2, num_policy_candidates=0
    )
    model = TaskWorldModel(TASK, HybridDynamics.pure_prior(TASK))
    start = TensorDict(observation=TASK.observe(torch.tensor([0.5, 0.0])))

    def plan(seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        planner = make_planner(model, None, None, settings, generator=generator)
        return torch.stack([planner(start.clone())["action"] for _ in range(5)])

    alone, found = [plan(seed) for seed in range(4)], {}
    threads = [
        threading.Thread(target=lambda seed=seed: found.update({seed: plan(seed)}))
        for seed in range(4)
    ]
    with set_exploration_type(ExplorationType.RANDOM):
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        assert exploration_type() is ExplorationType.RANDOM
    for seed in range(4):
        assert torch.equal(found[seed], alone[seed])
