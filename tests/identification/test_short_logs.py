"""Logs with few windows: a delay is found, or said to be undecided."""

from __future__ import annotations

import math

import pytest

from phihp_torchrl.identification import IdentifyConfig, identify
from phihp_torchrl.tasks import Actuator
from tests.identification.rigs import MASS, Mass, make_task, record

DELAY_ALONE = IdentifyConfig(
    lag=0.0, slew=0.0, dead_zone=0.0, gain_low=1.0, integrator="rk4", substeps=1
)


@pytest.mark.parametrize(("noise", "found"), [(2e-3, True), (0.04, False)])
def test_a_delay_in_a_short_log_is_found_or_said_to_be_undecided(noise: float, found: bool) -> None:
    late = Actuator(delay_steps=2.0)
    log = record(Mass(), MASS, samples=500, noise=(noise, math.nan), actuator=late, seed=1)
    result = identify(make_task(Mass()), [log], DELAY_ALONE)
    codes = [warning.code for warning in result.warnings]
    if found:
        assert result.actuator.delay_steps == 2.0
        assert "undecided" not in codes
        assert not any(trial.rival for trial in result.actuator.tried)
        return
    assert "undecided" in codes
    warning = next(w for w in result.warnings if w.code == "undecided")
    assert "identify.delay" in warning.advice
    path = {trial.part for trial in result.actuator.tried if trial.rival or trial.kept}
    assert "delay 2" in path  # the truth is among what is named


def test_no_delay_in_a_short_log_is_not_doubted() -> None:
    log = record(Mass(), MASS, samples=500, noise=(2e-3, math.nan), seed=1)
    result = identify(make_task(Mass()), [log], DELAY_ALONE)
    assert result.actuator.delay_steps == 0.0
    assert "undecided" not in [warning.code for warning in result.warnings]
