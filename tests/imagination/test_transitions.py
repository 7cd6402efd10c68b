"""Steps of a model that may leave the finite numbers."""

from __future__ import annotations

import math

import pytest
import torch

from phihp_torchrl.imagination import finite_transition

STATE = torch.tensor([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])
ACTION = torch.ones(3, 1)


def leads_to(next_state, reward, terminated=(False, True, False)):
    found = torch.tensor(next_state), torch.tensor(reward), torch.tensor(terminated)
    return finite_transition(lambda state, action: found, STATE, ACTION)


def test_a_finite_step_is_what_it_is():
    next_state, reward, terminated = leads_to([[1.0, 1.0]] * 3, [1.0, 2.0, 3.0])
    assert next_state.tolist() == [[1.0, 1.0]] * 3
    assert reward.tolist() == [1.0, 2.0, 3.0]
    assert terminated.tolist() == [False, True, False]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_step_into_no_number_stays_put_earns_nothing_and_ends(value):
    states = [[1.0, 1.0], [1.0, 1.0], [1.0, value]]
    next_state, reward, terminated = leads_to(states, [1.0, 2.0, 3.0])
    assert next_state.tolist() == [[1.0, 1.0], [1.0, 1.0], [4.0, 5.0]]
    assert reward.tolist() == [1.0, 2.0, 0.0]
    assert terminated.tolist() == [False, True, True]
    next_state, reward, terminated = leads_to([[1.0, 1.0]] * 3, [value, 2.0, 3.0])
    assert next_state.tolist() == [[0.0, 1.0], [1.0, 1.0], [1.0, 1.0]]
    assert reward.tolist() == [0.0, 2.0, 3.0]
    assert terminated.tolist() == [True, True, False]
