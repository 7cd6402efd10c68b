"""Dead times that differ from action to action."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from phihp_torchrl.identification import (
    Identification,
    IdentifyConfig,
    identified_task,
    identify,
    ready_to_paste,
    report_page,
)
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Actuator
from tests.identification.rigs import make_task, record

TRUE = {"left": 1.5, "right": 0.8, "stiffness": 3.0, "damping": 0.4}
ONLY = {
    "largest_delay": 3,
    "slew": 0.0,
    "dead_zone": 0.0,
    "gain_low": 1.0,
    "integrator": "rk4",
    "substeps": 1,
}
"""Delays alone are looked for."""


class Pushed(System):
    """A mass on a spring that two drives push, one of them through a softer coupling."""

    state_names = ("x", "v")
    action_names = ("left", "right")
    velocity_of = {"x": "v"}
    default_constants = {"left": 1.0, "right": 1.0, "stiffness": 4.0, "damping": 0.3}

    def prior(self, state: Tensor, action: Tensor, constants: dict) -> Tensor:
        c = constants
        push = c["left"] * action[..., 0] + c["right"] * action[..., 1]
        pull = c["stiffness"] * state[..., 0] + c["damping"] * state[..., 1]
        return torch.stack([state[..., 1], push - pull], -1)


def found_behind(drive: Actuator, samples: int = 500, **settings: object) -> Identification:
    log = record(Pushed(), TRUE, actuator=drive, noise=(1e-3, math.nan), samples=samples)
    return identify(make_task(Pushed()), [log], IdentifyConfig(**{**ONLY, **settings}))


def test_each_action_has_the_delay_that_it_has(tmp_path: Path) -> None:
    found = found_behind(Actuator((0.0, 2.0)), lag=0.0)
    assert found.actuator.delay_steps == (0.0, 2.0)
    for name, value in TRUE.items():
        assert found.constants[name].low < value < found.constants[name].high
    assert "delay_steps of right" in str(found)
    assert "dead time of right" in report_page(found)
    task = make_task(Pushed(), step=0.01)
    assert found.task(task).actuator == Actuator((0.0, 4.0)), "in steps half as long"
    assert "delay_steps: [0.0, 4.0]" in str(ready_to_paste(task, found))
    found.save(tmp_path / "identification.json")
    assert identified_task(task, tmp_path).actuator == Actuator((0.0, 4.0))


@pytest.mark.slow
def test_one_delay_stays_one_number() -> None:
    assert found_behind(Actuator(2.0), lag=0.0).actuator.delay_steps == 2.0
