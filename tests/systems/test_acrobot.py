"""The two-link arm: gymnasium's book equations, and what can be told of its constants."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control import AcrobotEnv
from physics import random_transition

from phihp_torchrl.systems import Acrobot, ElbowAcrobot, solve_inertia

EQUIVALENT = {
    "mass1": 1.4,
    "mass2": 0.8,
    "center1": 0.5,
    "center2": 0.625,
    "inertia1": 1.1,
    "inertia2": 0.9375,
}


def test_the_elbow_acrobot_is_gymnasiums_book_acrobot():
    book, system = AcrobotEnv(), ElbowAcrobot()
    assert book.book_or_nips == "book"
    state, action = random_transition(system)
    augmented = torch.cat([state, action], -1).numpy()
    expected = np.array([book._dsdt(s)[:4] for s in augmented])
    actual = system.prior(state, action, system.constants).numpy()
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)


def test_the_full_acrobot_with_an_idle_hinge_is_the_elbow_acrobot():
    state, action = random_transition(ElbowAcrobot())
    both = torch.cat([torch.zeros_like(action), action], -1)
    full, elbow = Acrobot(), ElbowAcrobot()
    torch.testing.assert_close(
        full.prior(state, both, full.constants), elbow.prior(state, action, elbow.constants)
    )


def test_identifiable_combinations_determine_the_prior():
    system = Acrobot()
    equivalent = {**system.constants, **EQUIVALENT}
    state, action = random_transition(system)
    assert system.identifiable(equivalent) == pytest.approx(system.identifiable(system.constants))
    torch.testing.assert_close(
        system.prior(state, action, equivalent), system.prior(state, action, system.constants)
    )


def test_its_constants_are_the_published_ones():
    for arm in (Acrobot(), ElbowAcrobot()):
        assert arm.constants["gravity"] == 9.8
        assert arm.constants["center1"] == arm.constants["center2"] == 0.5
        ones = ("mass1", "mass2", "length1", "inertia1", "inertia2")
        assert {arm.constants[name] for name in ones} == {1}


def test_the_inertia_is_solved():
    system = Acrobot()
    theta2, rest1, rest2 = torch.randn(3, 64, dtype=torch.float64)
    base = system.identifiable(system.constants)
    one, two = solve_inertia(theta2, rest1, rest2, base)
    coupled = base["coupling"] * theta2.cos()
    m11 = base["inertia_a"] + base["inertia_b"] + 2 * coupled
    m12 = base["inertia_b"] + coupled
    torch.testing.assert_close(m11 * one + m12 * two, rest1)
    torch.testing.assert_close(m12 * one + base["inertia_b"] * two, rest2)
