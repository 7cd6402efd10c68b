"""A discount that forgets most of an episode is warned of before any real step."""

from __future__ import annotations

from dataclasses import replace

import pytest

from phihp_torchrl.tasks import get_task
from phihp_torchrl.trainers import check_run
from phihp_torchrl.worlds import SimulatedWorld

from .run_parts import CONFIG, POLICY


@pytest.mark.parametrize(
    ("steps", "gamma", "warned"),
    [(2000, 0.99, True), (1900, 0.99, False), (2000, "20 s", False), (2000, 1.0, False)],
)
def test_a_discount_is_held_against_the_length_of_an_episode(caplog, steps, gamma, warned):
    task = replace(get_task("pendulum"), name="long", max_steps=steps)
    policy = replace(POLICY, td3=replace(POLICY.td3, gamma=gamma))
    sections = {**CONFIG.sections, "policy": policy}
    check_run(replace(CONFIG, sections=sections), SimulatedWorld(task))
    assert ("policy.td3.gamma = 0.99 counts rewards for about 100 steps" in caplog.text) == warned
    assert ("policy.td3.gamma='20 s'" in caplog.text) == warned
