"""What recordings of simulated rigs say of them."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
import torch
from torch import Tensor

from phihp_torchrl.config import ConfigError
from phihp_torchrl.identification import Identification, IdentifyConfig, identify
from phihp_torchrl.identification.diagnostics import late_advice, of_errors
from phihp_torchrl.identification.parts import IDENTIFIED, HorizonError, StateError
from phihp_torchrl.integrators import make_integrator
from phihp_torchrl.recordings import Recording
from phihp_torchrl.systems import System
from phihp_torchrl.tasks import Actuator
from tests import followed
from tests.identification.rigs import MASS, ROD, Mass, Rod, make_task, record

UNSEEN = math.nan
PLAIN: dict[str, Any] = {
    "delay": 0.0,
    "lag": 0.0,
    "slew": 0.0,
    "dead_zone": 0.0,
    "gain_low": 1.0,
    "integrator": "rk4",
    "substeps": 1,
}
"""A perfect drive, so that a fit is all there is."""


def inside(found: Identification, truth: dict[str, float]) -> dict[str, bool]:
    every = {**found.constants, **found.combinations}
    return {
        name: every[name].low <= value <= every[name].high  # type: ignore[operator]
        for name, value in truth.items()
    }


def codes(found: Identification) -> set[str]:
    return {warning.code for warning in found.warnings}


@pytest.fixture(scope="module")
def swing() -> Identification:
    log = record(Rod(), ROD, noise=(0.01, 0.05), samples=1000, hold=12, jitter=0.4)
    return identify(make_task(Rod()), [log], IdentifyConfig(**PLAIN))


def test_noise_does_not_bias_and_is_estimated(swing: Identification) -> None:
    ratios = {
        "gain / mass": ROD["gain"] / ROD["mass"],
        "viscous / mass": ROD["viscous"] / ROD["mass"],
    }
    assert all(inside(swing, {"length": ROD["length"], **ratios}).values())
    assert swing.noise["angle"] == pytest.approx(0.01, rel=0.1)
    assert swing.noise["speed"] == pytest.approx(0.05, rel=0.1)
    assert swing.errors["20"].floor_ratio < 2.0


def test_constants_of_a_product_are_said_to_be_so(swing: Identification) -> None:
    assert swing.constants["mass"].verdict == "only in combination with gain, viscous"
    assert swing.constants["mass"].low is None
    assert "No experiment" in swing.constants["mass"].advice
    assert swing.constants["gravity"].verdict == "fixed"
    assert swing.constants["length"].verdict == "identified"
    assert "combination" in codes(swing)


def test_an_irregular_clock_is_integrated_and_named(swing: Identification) -> None:
    assert "clock" in codes(swing)


def test_json_is_plain_and_has_its_keys(swing: Identification) -> None:
    plain = json.loads(json.dumps(swing.to_json(), allow_nan=False))
    assert {"constants", "actuator", "errors", "noise", "warnings"} <= set(plain)
    assert set(plain["constants"]["length"]) >= {"guess", "estimate", "low", "high", "verdict"}
    assert plain["actuator"]["delay_steps"] == 0.0
    assert set(plain["errors"]) == {"1", "5", "20"}
    assert all(isinstance(warning, str) for warning in plain["warnings"])
    assert "length" in str(swing)


def test_pictures_have_what_was_measured_beside_what_was_predicted(swing: Identification) -> None:
    rollout = swing.rollouts[0]
    lengths = {len(rollout.time), len(rollout.measured["angle"]), len(rollout.predicted["angle"])}
    assert lengths == {rollout.begin + 20}
    assert swing.residuals is not None
    assert len(swing.residuals.time) == len(swing.residuals.previous["volts 1 before"])


def test_the_task_takes_what_was_found(swing: Identification) -> None:
    task = swing.task(make_task(Rod()))
    assert task.system.constants["length"] == pytest.approx(ROD["length"], rel=0.02)
    assert task.actuator is None


def test_a_delay_that_is_not_modelled_is_named() -> None:
    log = record(Mass(), MASS, actuator=Actuator(2.0), noise=(1e-3, UNSEEN), samples=1000)
    found = identify(make_task(Mass()), [log], IdentifyConfig(**PLAIN))
    assert {"delay", "error"} <= codes(found)


def test_a_delay_is_found_with_positions_alone() -> None:
    log = record(Mass(), MASS, actuator=Actuator(2.0), noise=(1e-3, UNSEEN), samples=800)
    config = IdentifyConfig(**{**PLAIN, "delay": "auto"})
    found = identify(make_task(Mass()), [log], config)
    assert found.actuator.delay_steps == 2.0
    assert all(inside(found, MASS).values())
    task = found.task(make_task(Mass()))
    assert task.actuator == Actuator(2.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    "drive",
    [
        Actuator(1.4),
        Actuator(slew=30.0),
        Actuator(dead_zone=0.6, gain_low=0.7),
    ],
)
def test_the_path_of_the_command_is_found(drive: Actuator) -> None:
    log = record(Mass(), MASS, actuator=drive, noise=(1e-3, UNSEEN), samples=1000)
    found = identify(make_task(Mass()), [log])
    actuator = found.actuator.actuator
    assert actuator is not None
    assert set(actuator.config) == set(drive.config)
    for name, value in drive.config.items():
        assert getattr(actuator, name) == pytest.approx(value, rel=0.05)
    assert all(inside(found, MASS).values())


def test_stops_are_found_left_out_and_given_to_the_task() -> None:
    log = record(Mass(), MASS, stop=0.6, noise=(1e-3, UNSEEN), samples=1500)
    found = identify(make_task(Mass()), [log], IdentifyConfig(**PLAIN))
    assert "stops" in codes(found)
    assert found.stops["x"] == pytest.approx((-0.6, 0.6), abs=0.005)
    assert all(inside(found, MASS).values())
    stop = next(region for region in found.regions if region.state == "stop")
    assert stop.errors["x"].rmse < 0.05
    assert found.task(make_task(Mass())).position_limits["x"] == found.stops["x"]


def test_the_speed_that_a_stop_leaves_is_found_and_given_to_the_task() -> None:
    log = record(Mass(), MASS, stop=0.5, bounce=0.4, noise=(1e-3, UNSEEN), samples=1500)
    found = identify(make_task(Mass()), [log], IdentifyConfig(**PLAIN))
    bounce = found.restitution["x"]
    assert bounce.verdict == IDENTIFIED
    assert bounce.low <= 0.4 <= bounce.high
    assert bounce.high - bounce.low < 0.1
    stop = next(region for region in found.regions if region.state == "stop")
    assert stop.errors["x"].share < 0.1
    assert found.task(make_task(Mass())).restitution == {"x": bounce.estimate}
    assert "stops of" in found.table()


def test_outliers_do_not_bias() -> None:
    log = record(Mass(), MASS, noise=(1e-3, UNSEEN), samples=800)
    state = log.state.clone()
    state[::41, 0] += 0.3
    spoiled = Recording(log.time, state, log.action)
    found = identify(make_task(Mass()), [spoiled], IdentifyConfig(**PLAIN))
    for name, value in MASS.items():
        assert found.constants[name].estimate == pytest.approx(value, rel=0.02)
    assert found.noise["x"] == pytest.approx(1e-3, rel=0.15)


def test_gaps_and_missing_samples_are_counted_and_never_bridged() -> None:
    log = record(Mass(), MASS, noise=(1e-3, UNSEEN), samples=900)
    state = log.state.clone()
    state[::7, 0] = math.nan
    parts = [
        Recording(log.time[a:b], state[a:b], log.action[a:b])
        for a, b in ((0, 300), (305, 600), (601, 900))
    ]
    found = identify(make_task(Mass()), parts, IdentifyConfig(**PLAIN))
    assert "gaps" in codes(found)
    assert found.data["stretches"] == 3
    assert found.data["missing"]["x"] == int(state[:, 0].isnan().sum()) - 1  # one lay in a gap
    assert all(inside(found, MASS).values())


def test_a_command_that_never_changes_tells_nothing_of_its_gain() -> None:
    log = record(Mass(), MASS, noise=(1e-3, UNSEEN), samples=400, high=0.0)
    found = identify(make_task(Mass()), [log], IdentifyConfig(**PLAIN))
    assert found.constants["gain"].verdict == "not identified by these data"
    assert "action" in found.constants["gain"].advice
    assert {"unknown", "excitation"} <= codes(found)
    assert all(inside(found, {"stiffness": 6.0, "damping": 0.5}).values())


@pytest.mark.parametrize(("scale", "share"), [(1000.0, 99), (1.04, 0)])
def test_commands_in_other_units_are_named(scale: float, share: int) -> None:
    log = record(Mass(), MASS, noise=(1e-3, UNSEEN), samples=400)
    wrong = Recording(log.time, log.state, scale * log.action)
    found = identify(make_task(Mass()), [wrong], IdentifyConfig(**PLAIN))
    texts = [finding.text for finding in found.warnings if finding.code == "bounds"]
    assert len(texts) == bool(share)
    for text in texts:
        assert "beyond action_low=-5 or action_high=5; they go from -4" in text
        assert int(text.split()[1]) >= share
        assert text in found.table()
        assert any(text in warning for warning in found.to_json()["warnings"])


class Servo(System):
    """A motor whose torque constant also brakes it, so that no product has the drag."""

    state_names, action_names = ("angle", "speed"), ("volts",)
    velocity_of = {"angle": "speed"}
    default_constants = {"drag": 0.001, "inertia": 0.002, "torque": 0.05}

    def prior(self, state: Tensor, action: Tensor, constants: dict) -> Tensor:
        drag, inertia, torque = constants.values()
        speed = state[..., 1]
        force = torque * (action[..., 0] - torque * speed) - drag * speed
        return torch.stack([speed, force / inertia], -1)


class Sum(System):
    """A mass of which the motion tells a sum alone."""

    state_names, action_names = ("x", "v"), ("force",)
    velocity_of = {"x": "v"}
    default_constants = {"motor": 0.5, "hand": 0.3}

    def prior(self, state: Tensor, action: Tensor, constants: dict) -> Tensor:
        gain = constants["motor"] + constants["hand"]
        return torch.stack([state[..., 1], gain * action[..., 0] - state[..., 0]], -1)


def test_pairs_are_found_where_others_are_in_no_proportion() -> None:
    truth = {"drag": 0.0015, "inertia": 0.0025, "torque": 0.06}
    log = record(Servo(), truth, noise=(1e-3, UNSEEN), samples=800)
    found = identify(make_task(Servo()), [log], IdentifyConfig(**PLAIN))
    assert {c.verdict[:25] for c in found.constants.values()} == {"only in combination with "}
    assert list(found.combinations) == ["torque / inertia"]
    quotient = found.combinations["torque / inertia"]
    assert quotient.low <= 24.0 <= quotient.high
    assert quotient.high - quotient.low < 0.5
    assert "or use the combinations" in found.constants["torque"].advice


def test_combinations_that_are_none_are_not_advised() -> None:
    log = record(Sum(), {"motor": 0.7, "hand": 0.4}, noise=(1e-3, UNSEEN), samples=400)
    found = identify(make_task(Sum()), [log], IdentifyConfig(**PLAIN))
    assert found.combinations == {}
    for constant in found.constants.values():
        assert constant.verdict.startswith("only in combination with ")
        assert constant.advice.endswith("fix it with Constant(value, fixed=True).")


def test_what_was_done_already_is_not_advised() -> None:
    assert "let delay and lag be 'auto'." in late_advice(IdentifyConfig(**PLAIN), Actuator())
    sought = late_advice(IdentifyConfig(), Actuator(delay_steps=1.0))
    assert "auto" not in sought
    assert "largest_delay" not in sought
    assert "time stamps" in sought
    longest = late_advice(IdentifyConfig(), Actuator(delay_steps=(0.0, 5.0)))
    assert longest.endswith("slowly: allow a larger largest_delay than 5.")


def test_a_velocity_in_other_units_is_named() -> None:
    log = record(Mass(), MASS, noise=(1e-3, 1e-3), samples=400)
    state = log.state * torch.tensor([1.0, 57.3])
    found = identify(
        make_task(Mass()), [Recording(log.time, state, log.action)], IdentifyConfig(**PLAIN)
    )
    assert "velocity" in codes(found)


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"delay": -1.0}, "delay"),
        ({"gain_low": 0.0}, "gain_low"),
        ({"horizons": (0,)}, "horizons"),
        ({"integrator": "dopri5"}, "integrator"),
        ({"window": 3}, "window"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError) as error:
        IdentifyConfig(**settings)
    assert error.value.key == key


def test_recordings_that_do_not_fit_are_refused() -> None:
    task = make_task(Mass())
    with pytest.raises(ConfigError, match="expected one or more"):
        identify(task, [])
    with pytest.raises(ConfigError, match="expected columns"):
        identify(task, [Recording(torch.arange(9), torch.zeros(9, 3), torch.zeros(9, 1))])
    nothing = Recording(torch.arange(9), torch.full((9, 2), math.nan), torch.zeros(9, 1))
    with pytest.raises(ConfigError, match="NaN alone"):
        identify(task, [nothing])
    log = record(Mass(), MASS, samples=40)
    with pytest.raises(ConfigError, match="unknown state"):
        identify(task, [log], IdentifyConfig(stops={"y": (0.0, 1.0)}))


def test_inputs_are_refused_before_any_fit() -> None:
    log = Recording(torch.arange(9), torch.zeros(9, 2), torch.zeros(9, 1), inputs=torch.ones(9, 1))
    with pytest.raises(ConfigError, match=r"inputs: Mass has inputs \('wind',\), which"):
        identify(followed.followed(followed.Mass()), [log])


def by_eulers_steps(samples: int, step: float, delay: int = 0, noise: float = 0.0) -> Recording:
    """The mass, stepped by Euler's method, whose commands act so many samples late."""
    generator = torch.Generator().manual_seed(0)
    state, states = torch.tensor([0.3, 0.0]).double(), []
    command = 10.0 * torch.rand(samples, generator=generator).double() - 5.0
    command = command.repeat_interleave(3)[:samples, None]
    truth, layout = Mass().with_constants(MASS), Mass().layout()
    solver = make_integrator("semi_implicit_euler")
    for k in range(samples):
        states.append(state)
        u = command[max(0, k - delay)]
        state = solver(lambda s, u=u: truth.prior(s, u, truth.constants), state, step, layout)
    seen = torch.stack(states)
    seen = seen + noise * torch.randn(seen.shape, generator=generator)
    return Recording(step * torch.arange(samples), seen, command)


def test_a_rig_that_was_simulated_by_eulers_steps_is_integrated_so() -> None:
    settings = {**PLAIN, "integrator": "auto", "substeps": 0}
    task, log = make_task(Mass(), step=0.05), by_eulers_steps(400, 0.05)
    found = identify(task, [log], IdentifyConfig(**settings))
    assert found.settings["integrator"] == "semi_implicit_euler"
    assert found.constants["stiffness"].estimate == pytest.approx(MASS["stiffness"], rel=1e-3)


def test_a_delay_behind_eulers_steps_is_exact() -> None:
    """Behind Runge-Kutta's steps it would look like half a step more or less."""
    log = by_eulers_steps(1000, 0.2, delay=1, noise=0.003)
    found = identify(make_task(Mass(), step=0.2), [log])
    assert found.settings["integrator"] == "semi_implicit_euler"
    assert found.actuator.actuator is not None
    assert found.actuator.actuator.delay_steps == 1.0
    for name, value in MASS.items():
        each = found.constants[name]
        assert each.low <= value <= each.high
        assert each.estimate == pytest.approx(value, rel=0.01)


def test_intervals_of_incomplete_equations_are_doubted():
    def errors(ratio):
        theta = StateError(rmse=1.0, share=0.1, floor_ratio=ratio, count=9)
        return {"20": HorizonError({"theta": theta}, share=0.1, floor_ratio=ratio)}

    assert [f.code for f in of_errors(errors(1.1))] == []
    assert [f.code for f in of_errors(errors(2.5))] == ["error"]
    assert [f.code for f in of_errors(errors(9.0))] == ["incomplete", "error"]
