"""The rule of choice, by numbers made by hand."""

from __future__ import annotations

import math

import pytest

from phihp_torchrl.trainers.calibrate_rule import Choice, Way, choose, in_doubt, loses_nothing


def way(*returns: float, chatter: float = 0.4) -> Way:
    return Way(returns, (chatter,) * len(returns))


ACTOR = way(0.0, 0.0, 0.0, 0.0, chatter=0.0)
GIVEN = way(9.0, 11.0, 9.0, 11.0)  # a gain of 10


def pick(given: Way, *others: Way, actor: Way = ACTOR) -> Choice:
    """The choice between a plan as given, ``"0"``, and others, ``"1"`` and so on."""
    return choose({str(number): way for number, way in enumerate([given, *others])}, actor)


def chosen(*returns: float, chatter: float) -> str:
    """Which plan is chosen if another earns these returns."""
    return {"0": "as given", "1": "other"}[pick(GIVEN, way(*returns, chatter=chatter)).name]


# The settings as given, or others.


def test_the_settings_as_given_stay_where_others_are_better_by_noise_alone() -> None:
    # + 1 on average, with a paired standard error of 1.08
    assert chosen(13.0, 11.0, 11.0, 9.0, chatter=0.4) == "as given"


def test_the_noise_is_that_of_the_pairs() -> None:
    """Returns scatter by 1.2, the differences by 0.06."""
    assert chosen(9.9, 12.0, 10.1, 12.0, chatter=0.4) == "other"


def test_better_ones_may_chatter_more() -> None:
    assert chosen(19.0, 21.0, 19.5, 21.0, chatter=0.9) == "other"


@pytest.mark.parametrize(("chatter", "name"), [(0.26, "other"), (0.28, "as given"), (0.0, "other")])
def test_of_equal_gain_two_thirds_of_the_chatter_are_needed(chatter: float, name: str) -> None:
    assert chosen(9.0, 11.0, 9.0, 11.0, chatter=chatter) == name


def test_chatter_that_nobody_notices_changes_nothing() -> None:
    calm = way(9.0, 11.0, 9.0, 11.0, chatter=0.005)
    other = way(9.0, 11.0, 9.0, 11.0, chatter=0.0)
    assert pick(calm, other).name == "0"


@pytest.mark.parametrize("actor", [-100.0, 0.0, 990.0, 1000.0])
def test_smoothness_may_cost_a_trifle_of_the_return_whatever_the_actor_earns(actor: float) -> None:
    given, other = way(*(1000.0,) * 4), way(*(actor,) * 4, chatter=0.0)
    for loss, name in ((2.9, "1"), (3.1, "0")):
        assert pick(given, way(*(1000.0 - loss,) * 4, chatter=0.1), actor=other).name == name


def test_one_that_rests_has_the_benefit_of_doubt_until_it_looks_twice_as_dear() -> None:
    given = way(*(1000.0,) * 4, chatter=0.02)
    # It may cost 3. 5 with an error of 2.9, then of 0.6; 7 with one of 2.9.
    for losses, name in (((0, 0, 10, 10), "1"), ((4, 4, 6, 6), "0"), ((2, 2, 12, 12), "0")):
        resting = way(*(1000.0 - loss for loss in losses), chatter=0.0)
        assert pick(given, resting).name == name


def test_one_that_does_not_rest_has_no_benefit_of_doubt() -> None:
    smooth = way(*(1000.0 - loss for loss in (0, 0, 10, 10)), chatter=0.1)
    assert pick(way(*(1000.0,) * 4), smooth).name == "0"


def test_at_a_return_of_nothing_smoothness_must_be_free() -> None:
    given = way(-1.0, 1.0, -1.0, 1.0)
    worse = way(-1.1, 0.9, -1.0, 0.9, chatter=0.0)
    assert pick(given, worse).name == "0"
    free = way(-1.0, 1.0, -1.0, 1.0, chatter=0.0)
    assert pick(given, free).name == "1"


def test_of_several_calm_ones_the_calmest_that_costs_little_is_chosen() -> None:
    dear, cheap, calm = (
        way(*(earned,) * 4, chatter=chatter)
        for earned, chatter in ((980.0, 0.0), (998.0, 0.2), (998.0, 0.1))
    )
    assert pick(way(*(1000.0,) * 4), dear, cheap, calm).name == "3"


def test_one_that_rests_may_cost_a_little_more() -> None:
    actor = way(*(-1000.0,) * 4, chatter=0.0)
    given = way(*(-990.0,) * 4, chatter=0.5)
    assert pick(given, way(*(-995.0,) * 4, chatter=0.01), actor=actor).name == "1"
    assert pick(given, way(*(-995.0,) * 4, chatter=0.1), actor=actor).name == "0"
    assert pick(given, way(*(-1025.0,) * 4, chatter=0.01), actor=actor).name == "0"


def test_smoothness_does_not_hand_over_to_a_restless_actor() -> None:
    actor, given, calm = (
        way(*(earned,) * 4, chatter=chatter)
        for earned, chatter in ((-1000.0, 0.4), (-995.0, 0.5), (-1004.0, 0.01))
    )
    choice = pick(given, calm, actor=actor)
    assert (choice.name, choice.acting) == ("0", "planner")


def test_what_is_better_is_what_the_calm_ones_are_measured_by() -> None:
    better, calm = way(19.0, 21.0, 19.0, 21.5), way(12.0, 14.0, 12.0, 14.0, chatter=0.0)
    assert pick(GIVEN, calm).name == pick(GIVEN, better).name == "1"
    assert pick(GIVEN, calm, better).name == "2"


@pytest.mark.parametrize(
    ("returns", "chatter", "kept"),
    [
        ((1000.0, 1000.0, 1000.0, 1000.0), 0.4, True),
        ((1000.0, 1000.0, 1000.0, 1000.0), 0.42, False),  # it is rougher
        ((997.5, 997.5, 997.5, 997.5), 0.4, True),
        ((996.5, 996.5, 996.5, 996.5), 0.4, False),
        ((990.0, 1010.0, 990.0, 1010.0), 0.4, False),  # as good, but nobody knows
        ((1005.0, 1025.0, 1005.0, 1025.0), 0.4, True),
        ((1015.0, 1025.0, 1015.0, 1025.0), 0.9, True),  # rougher, and clearly better
        ((1001.0, 1002.0, 1001.0, 1002.0), 0.9, False),  # by next to nothing
        ((math.nan, 1000.0, 1000.0, 1000.0), 0.4, False),
    ],
)
def test_a_cheaper_plan_must_be_shown_to_lose_nothing(returns, chatter, kept) -> None:
    plan = way(*(1000.0,) * 4)
    assert loses_nothing(way(*returns, chatter=chatter), plan) is kept


# The plan, or the actor.


@pytest.mark.parametrize(
    ("returns", "acting", "certain"),
    [
        ((9.0, 11.0, 9.0, 11.0), "planner", True),  # 10 ± 0.6
        ((-1.0, 4.0, -1.0, 5.0), "planner", False),  # 1.75 ± 1.6
        ((-1.0, 4.0, -1.0, 2.0), "actor", False),  # 1 ± 1.2
        ((-3.0, 4.0, -3.0, 1.0), "actor", False),  # -0.25 ± 1.7
        ((-4.0, 1.0, -4.0, 1.0), "actor", False),  # -1.5 ± 1.4
        ((-9.0, -11.0, -9.0, -11.0), "actor", True),  # it is worse beyond doubt
        ((0.0, 0.0, 0.0, 0.0), "actor", True),  # they do the same
    ],
)
def test_a_plan_acts_if_it_is_ahead_by_a_standard_error(
    returns: tuple[float, ...], acting: str, certain: bool
) -> None:
    choice = pick(way(*returns))
    assert choice.gain == pytest.approx(sum(returns) / 4)
    assert (choice.acting, choice.certain) == (acting, certain)


def test_an_actor_that_is_no_smoother_acts_all_the_same_unless_the_plan_is_ahead() -> None:
    jumpy = way(0.0, 0.0, 0.0, 0.0, chatter=0.4)
    assert pick(way(-1.0, 4.0, -1.0, 5.0), actor=jumpy).acting == "planner"  # 1.75 ± 1.6
    assert pick(way(-1.0, 4.0, -1.0, 2.0), actor=jumpy).acting == "actor"  # 1 ± 1.2


def test_only_episodes_that_both_have_played_are_compared() -> None:
    longer = way(1.0, 3.0, 99.0, math.nan)
    assert way(0.0, 0.0).ahead_of(longer) == (-2.0, 1.0)
    assert longer.ahead_of(way(0.0, 0.0)) == (2.0, 1.0)


def test_settings_that_are_not_behind_the_actor_replace_those_that_are() -> None:
    """A plan that fails in some episodes is no better for being the one that was given."""
    failing = way(-400.0, 10.0, 10.0, -400.0)
    other = way(5.0, -1.0, 5.0, -1.0, chatter=0.9)
    choice = pick(failing, other)
    assert (choice.name, choice.acting) == ("1", "planner")
    assert pick(failing, way(*(-9.0,) * 4)).acting == "actor"


def test_of_equal_ones_a_clearly_smoother_plan_acts() -> None:
    jumpy = way(0.0, 0.0, 0.0, 0.0, chatter=0.7)
    assert pick(way(0.0, 0.0, 0.0, 0.0, chatter=0.1), actor=jumpy).acting == "planner"
    assert pick(way(0.0, 0.0, 0.0, 0.0, chatter=0.6), actor=jumpy).acting == "actor"


def test_where_confidence_is_below_one_so_is_the_bound() -> None:
    doubtful = way(-3.0, 4.0, -3.0, 1.0)
    assert choose({"given": doubtful}, ACTOR, confidence=0.0).acting == "actor"


# What is not finite.


def test_a_return_that_is_not_finite_is_never_chosen() -> None:
    bad = way(math.nan, 99.0, 99.0, 99.0, chatter=0.0)
    assert pick(GIVEN, bad).name == "0"
    assert pick(bad).acting == "actor"
    good = way(9.0, 11.0, 9.0, 11.0)
    assert pick(bad, good).name == "1"


# Models that fit the data about as well.


@pytest.mark.parametrize(
    ("other", "doubt"),
    [
        (GIVEN, False),
        (way(9.1, 11.1, 9.1, 11.1), False),  # by a hundredth
        (way(8.0, 10.0, 8.0, 10.0), True),
        (way(12.0, 12.0, 12.0, 12.0), True),
        (way(12.0, 8.0, 12.0, 6.0), False),  # no more than chance
        (way(9.0, 11.0, 9.0, math.nan), True),
    ],
)
def test_models_disagree_by_more_than_a_trifle_and_more_than_chance(other: Way, doubt: bool):
    assert in_doubt(GIVEN, [GIVEN, other]) is doubt


def test_one_model_cannot_disagree() -> None:
    assert in_doubt(GIVEN, []) is False


@pytest.mark.parametrize(("loss", "acting"), [(1.0, "planner"), (4.0, "actor")])
def test_where_the_model_is_doubted_a_plan_acts_unless_it_is_surely_behind(loss, acting) -> None:
    """It is rough, and behind by one or four with an error of 1.08."""
    actor = way(13.0, 11.0, 11.0, 9.0, chatter=0.0)
    plan = way(*(each - loss for each in (11.0, 13.0, 11.0, 9.0)))
    assert choose({"given": plan}, actor).acting == "actor"
    assert choose({"given": plan}, actor, doubted=True).acting == acting
