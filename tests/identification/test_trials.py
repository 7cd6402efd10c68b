"""What counts as clearly better, when paths of the command are compared window by window."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from phihp_torchrl.dynamics import signed_rank
from phihp_torchrl.identification import identify
from phihp_torchrl.tasks import Actuator
from tests.identification.rigs import MASS, ROD, Mass, Rod, make_task, record


def test_a_few_windows_that_are_far_off_do_not_hide_a_gain() -> None:
    gain = torch.randn(80, dtype=torch.float64) + 0.6
    gain[::20] = torch.tensor([30.0, -25.0, 40.0, -20.0]).double()
    assert gain.mean() / gain.std() * len(gain) ** 0.5 < 2.0
    assert signed_rank(gain) > 3.0
    assert signed_rank(-gain) == pytest.approx(-signed_rank(gain))


def test_gains_of_either_sign_are_rarely_clear() -> None:
    draws = torch.randn(2000, 40, dtype=torch.float64)
    scores = torch.tensor([signed_rank(draw**3) for draw in draws])  # of heavy tails
    assert float(scores.mean()) == pytest.approx(0.0, abs=0.1)
    assert float(scores.std()) == pytest.approx(1.0, abs=0.1)
    assert float((scores >= 3.0).double().mean()) < 0.004


class Dry(Mass):
    """The mass with dry friction, of which the equations that are fitted know nothing."""

    def prior(self, state: Tensor, action: Tensor, constants: dict) -> Tensor:
        rate = super().prior(state, action, constants)
        drag = 0.3 * torch.tanh(state[..., 1] / 0.02)
        return rate - torch.stack([torch.zeros_like(drag), drag], -1)


@pytest.mark.slow
def test_a_delay_is_found_in_a_short_log_with_friction_that_is_not_modelled() -> None:
    drive = Actuator(1.0)
    log = record(Dry(), MASS, actuator=drive, noise=(1e-3, math.nan), samples=600, seed=1, steps=4)
    assert identify(make_task(Mass()), [log]).actuator.actuator == drive


@pytest.mark.slow
def test_no_part_of_a_drive_is_chosen_where_there_is_none() -> None:
    log = record(Rod(), ROD, noise=(0.01, 0.05), samples=800)
    assert identify(make_task(Rod()), [log]).actuator.actuator is None
