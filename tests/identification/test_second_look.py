"""Paths of a command that no part alone explains, spikes, and stops that throw back."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from phihp_torchrl.identification import IdentifyConfig, identify
from phihp_torchrl.identification.spikes import without_spikes
from phihp_torchrl.identification.stops import suspect_stops
from phihp_torchrl.identification.windows import Samples, gather
from phihp_torchrl.recordings import Recording
from phihp_torchrl.tasks import Actuator
from tests.identification.rigs import MASS, Mass, make_task, record
from tests.identification.test_each_action import ONLY, TRUE, Pushed

STEP = 0.01


def logged(x: Tensor) -> Samples:
    """Positions alone, and commands that do not matter."""
    time = STEP * torch.arange(len(x), dtype=torch.float64)
    state = torch.stack([x, torch.full_like(x, math.nan)], -1)
    return gather(Mass(), [Recording(time, state, time[:, None])])


@pytest.mark.slow
def test_a_drive_that_pushes_less_to_one_side_is_not_taken_for_a_lag() -> None:
    drive = Actuator(2.0, gain_low=0.5)
    log = record(Mass(), MASS, actuator=drive, noise=(1e-3, math.nan), samples=1200)
    config = IdentifyConfig(**{**ONLY, "gain_low": "auto"})
    found = identify(make_task(Mass()), [log], config).actuator
    assert (found.delay_steps, found.lag_s) == (2.0, 0.0)
    assert found.gain_low == pytest.approx(0.5, abs=0.01)


@pytest.mark.slow
def test_each_action_has_the_lag_that_it_has() -> None:
    drive = Actuator((0.0, 1.0), (0.0, 0.04))
    log = record(Pushed(), TRUE, actuator=drive, noise=(5e-4, math.nan), samples=500)
    found = identify(make_task(Pushed()), [log], IdentifyConfig(**ONLY)).actuator
    assert found.delay_steps == (0.0, 1.0)
    assert isinstance(found.lag_s, tuple)
    assert found.lag_s == pytest.approx((0.0, 0.04), rel=0.2)
    assert list(found.intervals) == ["lag_s of right"]


def test_a_spike_is_left_out_and_a_hit_is_not() -> None:
    time = STEP * torch.arange(400, dtype=torch.float64)
    x = (2.0 * time).sin() + 1e-3 * torch.randn(400, generator=torch.Generator().manual_seed(0))
    x[200:] = 2.0 * x[200] - x[200:]  # the speed turns round
    spikes = [50, 51, 170, 300]  # two of them side by side
    x[spikes] += torch.tensor([0.5, -0.4, 0.2, -3.0])
    kept, findings = without_spikes(Mass(), logged(x))
    assert kept.state[:, 0].isnan().nonzero().flatten().tolist() == spikes
    assert [f.code for f in findings] == ["spikes"]
    assert "4 of x" in findings[0].text


def test_a_stop_that_throws_back_is_suspected_and_a_turn_is_not() -> None:
    x, v, places = 0.0, 1.7, []
    for _ in range(1600):
        places.append(x)
        x, v = x + STEP * v, v
        if abs(x) > 1.0:
            x, v = math.copysign(2.0, x) - x, -v
    noise = 1e-3 * torch.randn(1600, generator=torch.Generator().manual_seed(0))
    bounced = suspect_stops(Mass(), logged(torch.tensor(places).double() + noise))
    assert bounced["x"] == pytest.approx((-1.0, 1.0), abs=0.02)
    time = STEP * torch.arange(1600, dtype=torch.float64)
    swung = (2.7 * time).sin() * (1.0 + 0.1 * (0.6 * time).sin()) + noise
    assert suspect_stops(Mass(), logged(swung)) == {}
