"""The pendulum: what can be told of its constants."""

from __future__ import annotations

import pytest
import torch
from physics import random_transition

from phihp_torchrl.systems import Pendulum


def test_identifiable_combinations_determine_the_prior():
    system = Pendulum()
    equivalent = {"gravity": 20.0, "length": 2.0, "mass": 0.25}
    state, action = random_transition(system)
    assert system.identifiable(equivalent) == pytest.approx(system.identifiable(system.constants))
    torch.testing.assert_close(
        system.prior(state, action, equivalent), system.prior(state, action, system.constants)
    )


def test_the_combinations_are_the_papers():
    assert Pendulum().identifiable(Pendulum().constants) == {
        "gravity_gain": 15.0,
        "torque_gain": 3.0,
    }
