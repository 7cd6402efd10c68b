"""When learning ends at a plateau, how rates fall before, and what is no plateau."""

from __future__ import annotations

import copy
import itertools
import logging
from dataclasses import replace

import pytest
import torch

from phihp_torchrl.trainers.plateau import Plateau, Schedule
from phihp_torchrl.trainers.policy_evaluation import Played

from .trainer_parts import POLICY, assert_same_state, plain, policy_trainer

FLAT = torch.zeros(8)
UPDATES = 1000


class Known:
    """A floor with a given share of the starts at it."""

    def __init__(self, at_floor=0.0):
        self.at_floor = at_floor

    def share(self, returns):
        return self.at_floor


def plateau(at_floor=0.0, decay=0.0, extension=0.0):
    schedule, floor = Schedule(UPDATES, decay), Known(at_floor)
    return Plateau(schedule, 0.2, 0.15, round_to=100, floor=lambda: floor, extension=extension)


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


RISING = [FLAT + 10.0 * k for k in range(1, 40)]


@pytest.mark.parametrize(
    ("extension", "later"), [(0.0, 0), (0.09, 0), (0.1, 100), (0.35, 300), (1.0, 1000)]
)
def test_rates_wait_for_returns_that_rise_fast(caplog, extension, later):
    caplog.set_level(logging.INFO)
    watch = plateau(decay=0.5, extension=extension)
    assert end_of(watch, RISING) == UPDATES + later
    assert watch.schedule.falls == UPDATES / 2 + later
    assert caplog.text.count("still rise fast at update 500") == (later > 0)


@pytest.mark.parametrize(
    ("steps", "later"),
    [
        ([1.0] * 4 + [0.1] * 9, 0),  # a fortieth of what is gained, when it is asked
        ([1.0] * 6 + [0.1] * 9, 200),
        ([1.0] * 4 + [0.0] + [1.0] * 9, 0),  # when it is asked, they stand
    ],
    ids=str,
)
def test_rates_fall_once_returns_rise_slowly(steps, later):
    watch = plateau(decay=0.5, extension=1.0)
    watch.patience = UPDATES
    assert end_of(watch, list(FLAT + torch.tensor(steps).cumsum(0)[:, None])) == UPDATES + later


def test_what_is_put_off_may_still_land_early():
    watch = plateau(decay=0.5, extension=1.0)
    end = end_of(watch, [*RISING[:7], *[RISING[6]] * 9])
    assert watch.schedule.later == 300  # at updates 500 to 700
    assert end == watch.schedule.landing + 200 < UPDATES + 300
    scales = [watch.schedule.scale(k) for k in (600, 800, 900, end)]
    assert scales == pytest.approx([1.0, 1.0, 0.8, 0.05], abs=0.21)
    assert scales == sorted(scales, reverse=True)


def test_what_is_put_off_is_kept_by_a_checkpoint():
    whole = plateau(decay=0.5, extension=1.0)
    end_of(whole, RISING[:6])
    resumed = plateau(decay=0.5, extension=1.0)
    resumed.load_state_dict(copy.deepcopy(whole.state_dict()))
    for watch in (whole, resumed):
        for k, each in enumerate(RISING[6:9], 7):
            watch.see(100 * k, each)
    assert whole.schedule.later == resumed.schedule.later == 500
    assert whole.schedule.state_dict() == resumed.schedule.state_dict()
    old = {key: value for key, value in whole.state_dict().items() if key != "lately"}
    del old["schedule"]["later"]
    resumed.load_state_dict(old)
    assert resumed.schedule.later == 0


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


@pytest.mark.parametrize("extension", [0.0, 0.5])
def test_learning_goes_on_while_returns_rise(extension):
    trainer = policy_trainer(replace(POLICY, updates=40, patience=0.5, extension=extension))
    rising = itertools.count()
    trainer.evaluation.imagined = lambda actor: Played(FLAT + next(rising), 0.0)
    while not trainer.done:
        end = trainer.advance()["policy/end"]
    assert trainer.updates == end == 40 + 40 * extension


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
