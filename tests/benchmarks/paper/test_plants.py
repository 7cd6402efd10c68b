"""What impaired plants cost: settings that exist, and shares of the return counted by hand."""

from __future__ import annotations

import pytest

import plants
from phihp_torchrl import load_config, make_world
from phihp_torchrl.trainers import read_run_config

ORIGIN = {
    "commit": "0123456789abcdef",
    "dirty": False,
    "machine": {"cpus": 2, "memory_gib": 8.0, "gpus": 0},
}


def entry(plant, returns, seed=101, acting="planner"):
    return {"task": "cartpole-swingup", "plant": plant, "seed": seed, "floor": -10.0,
            "returns": {acting: returns}, "chatter": {acting: 0.25}, "origin": ORIGIN}  # fmt: skip


@pytest.mark.parametrize("plant", plants.PLANTS)
@pytest.mark.parametrize("task", plants.TASKS)
def test_every_plant_is_a_world_of_which_the_task_knows_nothing(task, plant):
    lines = list(plants.changes(task, plant))
    config = read_run_config(load_config(task, overrides=lines))
    world = make_world(task, config.world)
    assert (world.model() is None) == (plant != plants.AS_IT_IS)
    assert all(line.startswith("world.") for line in lines)
    assert world.copies


def test_the_share_is_counted_from_the_floor():
    whole, late = entry(plants.AS_IT_IS, [80.0, 100.0]), entry("lag of 40 ms", [80.0, 80.0])
    assert plants.lost(late, whole) == pytest.approx(0.1)
    actor = entry("noise", [90.0], acting="actor")
    assert plants.lost(actor, whole) == 0.0


def test_each_seed_is_compared_with_itself():
    found = [entry(plants.AS_IT_IS, [90.0]), entry("noise", [80.0], seed=102)]
    rows = plants.page(found).splitlines()
    assert any("| noise | 102 | 80.0 | – |" in row for row in rows)
    assert any("| as it is | 101 | 90.0 | 0.0 |" in row for row in rows)
