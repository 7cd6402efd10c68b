"""The crane in newtons: its task, and the page of its results."""

from __future__ import annotations

import pytest
import torch

import learn_crane
from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.baselines import make_baselines
from phihp_torchrl.origin import describe_origin
from phihp_torchrl.trainers import import_plugins


@pytest.fixture(scope="module", autouse=True)
def rig():
    import_plugins([str(learn_crane.RIG)])


def test_a_push_moves_the_trolley_by_its_own_mass_at_first():
    system = get_task("heavy-crane").system
    rate = system.prior(torch.zeros(4), torch.tensor([4000.0]), system.constants)
    torch.testing.assert_close(rate, torch.tensor([0.0, 0.0, 5.0, -5.0 / 8.0]))


def test_an_lqr_brings_the_load_to_its_place():
    task = get_task("heavy-crane")
    model = HybridDynamics.pure_prior(task)
    lqr = make_baselines(task, model, ["lqr"])["lqr"]
    state = torch.tensor([-5.0, 0.0, 0.0, 0.0])
    for _ in range(task.max_steps):
        state = model(state, task.clip_action(lqr.act(state))).detach()
    assert state.abs().max() < 0.05


def test_a_run_with_one_strategy_is_kept_beside_the_other(tmp_path):
    for settings in ({}, {"policy.strategies": []}):
        settings = {"model.real_steps": 9, "policy.updates": 8, **settings}
        result = {
            "seed": 7,
            "settings": settings,
            "seconds": 6.0,
            "metrics": {"policy/imagined_return": -5.0},
            "results": {"actor": {"returns": [-2.0, -4.0]}},
            "origin": describe_origin(7),
        }
        learn_crane.write(result, tmp_path)
    assert len(list(tmp_path.glob("*.json"))) == 2
    page = (tmp_path / "README.md").read_text()
    assert page.count("| actor | -3.0 | 1.0 |") == 2
    assert "seed 7, one strategy" in page
