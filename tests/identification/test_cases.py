"""Logs of three rigs, as a person would record them, and what made them.

``tests/cases`` has a geared pendulum (a counting encoder, a drive that acts two samples late, dry
friction, no speed), two tanks (a jittering clock, lost rows and values, a pump that lags) and a
cart with a pole on a short rail (positions alone, hard stops that it hits often).
"""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from phihp_torchrl.identification import Identification, identify
from phihp_torchrl.recordings import Recording
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Box, Task

CASES = Path(__file__).parents[1] / "cases"
TRUTH = json.loads((CASES / "truth.json").read_text())
G = 9.81


class Pendulum(System):
    state_names = ("angle", "speed")
    action_names = ("volts",)
    angles = ("angle",)
    velocity_of = {"angle": "speed"}
    default_constants = {
        "mass": 0.3,
        "length": 0.3,
        "gain": 0.05,
        "viscous": 0.01,
        "coulomb": 0.01,
    }

    def prior(self, state: Tensor, action: Tensor, constants: dict) -> Tensor:
        m, l, gain, viscous, coulomb = constants.values()
        angle, speed = state.unbind(-1)
        friction = viscous * speed + coulomb * torch.tanh(speed / 0.02)
        torque = gain * action[..., 0] - m * G * l / 2.0 * angle.sin() - friction
        return torch.stack([speed, torque / (m * l**2 / 3.0)], -1)

    def identifiable(self, constants: dict) -> dict:
        m, l, gain, viscous, coulomb = constants.values()
        inertia = m * l**2 / 3.0
        return {
            "gain/inertia": gain / inertia,
            "1.5 g/l": 1.5 * G / l,
            "viscous/inertia": viscous / inertia,
            "coulomb/inertia": coulomb / inertia,
        }


class Tanks(System):
    state_names = ("level_1", "level_2")
    action_names = ("pump",)
    default_constants = {
        "area_1": 0.02,
        "area_2": 0.02,
        "outlet_1": 5e-5,
        "outlet_2": 5e-5,
        "flow": 1e-4,
    }

    def prior(self, state: Tensor, action: Tensor, constants: dict) -> Tensor:
        area_1, area_2, outlet_1, outlet_2, flow = constants.values()
        first, second = (2.0 * G * state.clamp_min(1e-6)).sqrt().unbind(-1)
        between = outlet_1 * first
        return torch.stack(
            [
                (flow * action[..., 0] - between) / area_1,
                (between - outlet_2 * second) / area_2,
            ],
            -1,
        )


class Rail(System):
    state_names = ("x", "x_dot", "theta", "theta_dot")
    action_names = ("force",)
    angles = ("theta",)
    velocity_of = {"x": "x_dot", "theta": "theta_dot"}
    default_constants = {
        "cart": 0.5,
        "pole": 0.2,
        "half": 0.2,
        "cart_coulomb": 0.1,
        "pole_viscous": 0.001,
    }

    def prior(self, state: Tensor, action: Tensor, constants: dict) -> Tensor:
        cart, m, l, coulomb, viscous = constants.values()
        _, v, theta, w = state.unbind(-1)
        sin, cos = theta.sin(), -theta.cos()  # of the angle from upright, pi - theta
        total = cart + m
        force = action[..., 0] - coulomb * torch.tanh(v / 0.005) + m * l * w.square() * sin
        pull = G * sin + viscous * w / (m * l)
        turn = (pull - cos * force / total) / (l * (4.0 / 3.0 - m * cos.square() / total))
        return torch.stack([v, force / total - m * l * turn * cos / total, w, -turn], -1)


def read(name: str) -> Tensor:
    with (CASES / name).open() as file:
        rows = list(csv.reader(file))[1:]
    return torch.tensor([[float(x or "nan") for x in row] for row in rows], dtype=torch.float64)


def make_task(system: System, low: float, high: float, step: float) -> Task:
    box = Box((0.0,) * system.state_dim, (0.1,) * system.state_dim)
    return Task(
        "rig", system, (high,), step, 500, box, lambda s, a, n: s[..., 0], action_low=(low,)
    )


def check(found: Identification, truth: dict[str, float]) -> None:
    every = {**found.constants, **found.combinations}
    for name, value in truth.items():
        estimate = every[name]
        assert estimate.low is not None, name
        assert estimate.high is not None, name
        assert estimate.low <= value <= estimate.high, name
        assert estimate.high - estimate.low < 0.2 * abs(estimate.estimate), name
    assert found.errors["20"].floor_ratio < 1.5


@pytest.mark.slow
def test_the_pendulum() -> None:
    time, angle, volts = read("pendulum.csv")[:1500].T
    state = torch.stack([angle, torch.full_like(angle, math.nan)], -1)
    log = Recording(time, state, volts[:, None], "pendulum.csv")
    found = identify(make_task(Pendulum(), -6.0, 12.0, 0.02), [log])
    truth = TRUTH["pendulum"]
    inertia = truth["mass"] * truth["length"] ** 2 / 3.0
    shares = {f"{name}/inertia": truth[name] / inertia for name in ("viscous", "coulomb")}
    check(found, {**truth["products"], **shares})
    assert found.actuator.delay_steps == truth["delay"]
    assert found.constants["mass"].verdict.startswith("only in combination with gain")


@pytest.mark.slow
def test_the_tanks() -> None:
    rows = read("tanks.csv")
    gaps = (rows[:, 0].diff() > 1.6 * rows[:, 0].diff().median()).nonzero().flatten() + 1
    parts = rows.tensor_split(gaps.tolist())
    logs = [
        Recording(part[:, 0], part[:, 1:3] / 100.0, part[:, 3:] / 100.0, "tanks.csv")
        for part in parts
        if len(part) > 1
    ]
    found = identify(make_task(Tanks(), 0.0, 1.0, 1.0), logs)
    truth = TRUTH["tanks"]
    names = ("area_2", "outlet_1", "outlet_2", "flow")
    check(found, {f"{name} / area_1": truth[name] / truth["area_1"] for name in names})
    assert found.actuator.lag_s == pytest.approx(truth["lag"], rel=0.2)
    assert {"clock", "gaps", "combination"} <= {warning.code for warning in found.warnings}


@pytest.mark.slow
def test_the_rail() -> None:
    time, cart, pole, force = read("rail.csv")[:3000].T
    unseen = torch.full_like(cart, math.nan)
    state = torch.stack([cart / 1000.0, unseen, pole * math.pi / 180.0, unseen], -1)
    found = identify(
        make_task(Rail(), -6.0, 6.0, 0.01), [Recording(time, state, force[:, None], "rail.csv")]
    )
    truth = TRUTH["rail"]
    check(found, {name: truth[name] for name in found.constants})
    assert found.actuator.actuator is None
    assert found.stops["x"] == pytest.approx((-truth["stop"], truth["stop"]), abs=0.002)
