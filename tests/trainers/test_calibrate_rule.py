"""The rule of choice, by numbers made by hand."""

from __future__ import annotations

import math

import pytest

from phihp_torchrl.trainers.calibrate_rule import Finalist, choose


def way(*returns: float, chatter: float = 0.4, changes: dict | None = None) -> Finalist:
    return Finalist(returns, (chatter,) * len(returns), changes or {})


ACTOR = way(0.0, 0.0, 0.0, 0.0, chatter=0.0)
GIVEN = way(9.0, 11.0, 9.0, 11.0)  # a gain of 10
OTHER = {"alpha": 0.5}


def chosen(*returns: float, chatter: float) -> str:
    """Why the plan is chosen if another earns these returns."""
    return choose(GIVEN, way(*returns, chatter=chatter, changes=OTHER), ACTOR).reason


# The settings as given, or others.


def test_the_settings_as_given_stay_where_others_are_better_by_noise_alone() -> None:
    # + 1 on average, with a paired standard error of 1.08
    assert chosen(13.0, 11.0, 11.0, 9.0, chatter=0.4) == "as given"


def test_the_noise_is_that_of_the_pairs() -> None:
    """Returns scatter by 1.2, the differences by 0.06."""
    assert chosen(9.9, 12.0, 10.1, 12.0, chatter=0.4) == "better"


def test_better_ones_may_chatter_more() -> None:
    assert chosen(19.0, 21.0, 19.5, 21.0, chatter=0.9) == "better"


@pytest.mark.parametrize(
    ("chatter", "reason"), [(0.26, "smoother"), (0.28, "as given"), (0.0, "smoother")]
)
def test_of_equal_gain_two_thirds_of_the_chatter_are_needed(chatter: float, reason: str) -> None:
    assert chosen(9.0, 11.0, 9.0, 11.0, chatter=chatter) == reason


def test_chatter_that_nobody_notices_changes_nothing() -> None:
    calm = way(9.0, 11.0, 9.0, 11.0, chatter=0.005)
    other = way(9.0, 11.0, 9.0, 11.0, chatter=0.0, changes=OTHER)
    assert choose(calm, other, ACTOR).reason == "as given"


def test_smoothness_may_cost_a_tenth_of_the_gain() -> None:
    # - 0.4 with a paired error of 0.9, then of 0.04; a tenth of the gain is 1
    assert chosen(6.6, 10.6, 8.6, 12.6, chatter=0.1) == "smoother"
    assert chosen(8.5, 10.6, 8.7, 10.6, chatter=0.1) == "smoother"
    # - 1.25 with a paired error of 2.8, then of 0.08
    assert chosen(1.0, 17.0, 6.0, 11.0, chatter=0.0) == "as given"
    assert chosen(7.8, 9.7, 7.7, 9.8, chatter=0.0) == "as given"


def test_smoothness_may_cost_a_thousandth_of_the_return() -> None:
    given, actor = way(1000.0, 1000.0, 1000.0), way(1000.0, 1001.0, 999.0, chatter=0.0)
    for loss, reason in ((0.9, "smoother"), (1.1, "as given")):
        calm = way(*(1000.0 - loss,) * 3, chatter=0.1, changes=OTHER)
        assert choose(given, calm, actor).reason == reason


def test_where_the_plan_gains_nothing_smoothness_must_be_free() -> None:
    given, actor = way(-1.0, 1.0, -1.0, 1.0), ACTOR
    worse = way(-1.1, 1.0, -1.0, 1.05, chatter=0.0, changes=OTHER)
    assert choose(given, worse, actor).reason == "as given"
    free = way(-1.0, 1.0, -1.0, 1.0, chatter=0.0, changes=OTHER)
    assert choose(given, free, actor).plan == free


# The plan, or the actor.


@pytest.mark.parametrize(
    ("returns", "acting", "certain"),
    [
        ((9.0, 11.0, 9.0, 11.0), "planner", True),  # 10 ± 0.6
        ((-1.0, 4.0, -1.0, 5.0), "planner", False),  # 1.75 ± 1.6
        ((-3.0, 4.0, -3.0, 1.0), "planner", False),  # -0.25 ± 1.7
        ((-4.0, 1.0, -4.0, 1.0), "actor", False),  # -1.5 ± 1.4
        ((-9.0, -11.0, -9.0, -11.0), "actor", True),  # it is worse beyond doubt
        ((0.0, 0.0, 0.0, 0.0), "actor", True),  # they do the same
    ],
)
def test_a_plan_acts_unless_the_actor_is_ahead_by_a_standard_error(
    returns: tuple[float, ...], acting: str, certain: bool
) -> None:
    choice = choose(way(*returns), None, ACTOR)
    assert choice.gain == pytest.approx(sum(returns) / 4)
    assert (choice.acting, choice.certain) == (acting, certain)


def test_of_equal_ones_a_clearly_smoother_plan_acts() -> None:
    jumpy = way(0.0, 0.0, 0.0, 0.0, chatter=0.7)
    assert choose(way(0.0, 0.0, 0.0, 0.0, chatter=0.1), None, jumpy).acting == "planner"
    assert choose(way(0.0, 0.0, 0.0, 0.0, chatter=0.6), None, jumpy).acting == "actor"


def test_late_stretches_count_as_often_as_there_are_unless_they_drown_the_rest() -> None:
    actor = Finalist((0.0, 0.0), (0.1, 0.1), late=(0.0, 0.0))
    for late, ahead in (((-1.0, -1.2), 3.0 - 10 * 1.1), ((-1.0, -3.0), 3.0 - 2 * 2.0)):
        ours = Finalist((1.0, 5.0), (0.1, 0.1), late=late, weight=10.0)
        assert ours.ahead_of(actor)[0] == pytest.approx(ahead)


def test_late_stretches_are_added_to_the_difference() -> None:
    early = {"returns": (1.0, 2.0), "chatter": (0.1, 0.1)}
    ours = Finalist(**early, late=(5.0, 6.0))
    theirs = Finalist((0.0, 1.0), (0.1, 0.1), late=(3.0, 4.0))
    assert ours.ahead_of(theirs) == (3.0, 0.0)
    assert Finalist(**early, late=(math.nan, 6.0)).fails


def test_where_confidence_is_below_one_so_is_the_bound() -> None:
    doubtful = way(-3.0, 4.0, -3.0, 1.0)
    assert choose(doubtful, None, ACTOR, confidence=0.0).acting == "actor"


# What is not finite.


def test_a_return_that_is_not_finite_is_never_chosen() -> None:
    bad = way(math.nan, 99.0, 99.0, 99.0, chatter=0.0, changes=OTHER)
    assert choose(GIVEN, bad, ACTOR).reason == "as given"
    assert choose(bad, None, ACTOR).acting == "actor"
    good = way(9.0, 11.0, 9.0, 11.0, changes=OTHER)
    assert choose(bad, good, ACTOR).plan == good
