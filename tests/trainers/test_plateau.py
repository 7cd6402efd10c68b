"""When learning ends at a plateau, how rates fall before, and what is no plateau."""

from __future__ import annotations

import copy
import logging
from dataclasses import replace

import pytest
import torch

from phihp_torchrl.trainers.plateau import Plateau, Schedule

from .trainer_parts import POLICY, assert_same_state, plain, policy_trainer

FLAT = torch.zeros(8)
UPDATES = 1000


class Known:
    """A floor with a given share of the starts at it."""

    def __init__(self, at_floor=0.0):
        self.at_floor = at_floor

    def share(self, returns):
        return self.at_floor


def plateau(at_floor=0.0):
    schedule = Schedule(UPDATES, decay=0.0)
    return Plateau(schedule, 0.2, 0.15, round_to=100, floor=lambda: Known(at_floor))


def end_of(watch, returns):
    """Where learning ends if an actor with these returns is seen every 100 updates."""
    watch.see(0, FLAT)
    for k, each in enumerate(returns, 1):
        watch.see(100 * k, each)
    return watch.schedule.end


def test_rising_returns_go_to_the_end():
    assert end_of(plateau(), [FLAT + k for k in range(1, 11)]) == UPDATES


def test_standing_returns_end_after_patience_and_tail(caplog):
    caplog.set_level(logging.INFO)
    watch = plateau()
    assert end_of(watch, [FLAT + 5.0] * 3) == 300 + 200  # 0.15 of 1,000, in hundreds
    assert watch.schedule.landing == 300
    assert "have stood at 5 since update 100" in caplog.text
    assert "learning ends at update 500 of 1000" in caplog.text


def test_a_later_rise_does_not_take_the_landing_back():
    watch = plateau()
    assert end_of(watch, [*[FLAT + 5.0] * 3, FLAT + 50.0]) == 500
    assert watch.level.mean() == 50.0


@pytest.mark.parametrize(
    ("change", "is_rise"),
    [
        (torch.full((8,), 0.5), True),
        (torch.full((8,), 0.005), False),  # under 1 % of what is gained
        (torch.tensor([3.0, -3.0] * 4), False),  # no more than noise
        (torch.tensor([8.0, -2.0, *[0.0] * 6]), False),
    ],
)
def test_a_rise_is_paired_and_of_a_size(change, is_rise):
    watch = plateau()
    end_of(watch, [FLAT + 10.0])
    watch.see(200, FLAT + 10.0 + change)
    assert (watch.risen == 200) is is_rise


def test_at_the_floor_nothing_is_a_plateau():
    assert end_of(plateau(at_floor=0.5), [FLAT + 2.0] * 9) == UPDATES


def test_returns_that_are_not_finite_are_no_rise():
    watch = plateau()
    assert end_of(watch, [FLAT + 5.0, FLAT - torch.inf, FLAT - torch.inf]) == 500
    assert watch.risen == 100


def test_rates_fall_from_where_they_are_to_a_twentieth():
    schedule = Schedule(UPDATES, decay=1.0)
    schedule.land(500, over=200)
    scales = [schedule.scale(k) for k in (499, 500, 600, 700, 900)]
    assert scales == pytest.approx([0.501, 0.5, 0.275, 0.05, 0.05])
    assert schedule.end == 700
    late = Schedule(UPDATES, decay=0.0)
    late.land(900, over=200)
    assert late.end == UPDATES, "no later than without a plateau"


def test_learning_stops_at_a_plateau_and_keeps_the_best():
    # Rates of almost zero: what is imagined stands still but for the first step away from nothing.
    td3 = replace(POLICY.td3, actor_learning_rate=1e-12, critic_learning_rate=1e-12)
    config = replace(POLICY, updates=40, td3=td3, patience=0.2, tail=0.1)
    trainer = policy_trainer(config)
    trainer.plateau.make_floor = Known
    ends = []
    while not trainer.done:
        ends.append(trainer.advance()["policy/end"])
    assert ends == [40.0, 12.0, 12.0]
    assert trainer.progress == (12, 12)


@pytest.mark.parametrize("done_before", [1, 3])
def test_a_resumed_run_ends_at_the_same_plateau(done_before):
    config = replace(POLICY, updates=40, patience=0.2, tail=0.2)
    whole, first = policy_trainer(config), policy_trainer(config)
    for trainer in (whole, first):
        trainer.plateau.make_floor = Known
    for _ in range(done_before):
        whole.advance()
        first.advance()
    saved = copy.deepcopy(first.state_dict())
    plain(saved)
    resumed = policy_trainer(config, seed=7, dynamics=copy.deepcopy(first.world_model.transitions))
    resumed.plateau.make_floor = Known
    resumed.load_state_dict(saved)
    while not whole.done:
        expected, metrics = whole.advance(), resumed.advance()
        for key in expected.keys() - {"policy/seconds"}:
            assert metrics[key] == expected[key], key
    assert resumed.done
    assert_same_state(whole.state_dict(), resumed.state_dict(), but=["seconds"])


def test_without_patience_nothing_is_added():
    trainer = policy_trainer()
    assert trainer.plateau is None
    assert "policy/end" not in trainer.advance()
    assert "plateau" not in trainer.state_dict()


def test_a_run_from_before_is_patient_from_where_it_goes_on():
    trainer = policy_trainer(replace(POLICY, updates=40))
    for _ in range(5):
        trainer.advance()
    resumed = policy_trainer(replace(POLICY, updates=40, patience=0.2))
    resumed.load_state_dict(copy.deepcopy(trainer.state_dict()))
    assert resumed.advance()["policy/end"] == 40.0
    assert resumed.plateau.risen == 24
