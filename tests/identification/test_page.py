"""The page of an identification: whole, safe with any name, and alone in the world."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from html import unescape

import pytest
from pages import read

from phihp_torchrl.display import Series, chart, interval_bar, thin
from phihp_torchrl.identification import (
    ActuatorEstimate,
    ActuatorTrial,
    Estimate,
    Finding,
    HorizonError,
    Identification,
    Region,
    Residuals,
    Rollout,
    StateError,
    ready_to_paste,
    report_page,
)
from phihp_torchrl.systems import Constant, System
from phihp_torchrl.tasks import Actuator, Box, Task

EVIL = '<script>alert("x")</script>&\''


def sample(name: str = "angle", action: str = "volts", source: str = "a.csv") -> Identification:
    """An identification with something in each of its parts."""
    time = [0.1 * k for k in range(12)]
    wave = [math.sin(t) for t in time]
    gap: list[float | None] = [None, *wave[1:]]
    error = HorizonError({name: StateError(0.01, 0.02, 1.2, 40)}, 0.02, 1.2)
    bad = StateError(0.5, math.nan, 9.0, 4)
    past = {f"{action} {k} before": wave for k in (1, 2)}
    return Identification(
        constants={
            "mass": Estimate(0.3, 0.31, 0.3099, 0.3101),
            "gain": Estimate(
                1.0, 1.5, None, None, "only in combination with drag", "Use gain/drag."
            ),
            "drag": Estimate(0.1, 0.1, None, None, "not identified by these data", "Spin it."),
            "tilt": Estimate(0.1, 0.2, 0.19, 0.2, "at its limit", "Widen its range."),
            "gravity": Estimate(9.81, 9.81, 9.81, 9.81, "fixed"),
        },
        combinations={"gain / drag": Estimate(10.0, 15.0, 14.0, 16.0)},
        actuator=ActuatorEstimate(
            delay_steps=2.0,
            lag_s=0.05,
            intervals={"lag_s": (0.04, 0.06)},
            tried=(
                ActuatorTrial("at once", {}, 80.0),
                ActuatorTrial("delay 2, lag", {"delay_steps": 2.0, "lag": 0.05}, 1.0, kept=True),
            ),
        ),
        errors={"1": error, "20": error},
        regions=(
            Region(name, -1.0, 0.0, 20, {name: StateError(0.01, 0.02, 1.1, 20)}),
            Region("stop", None, None, 4, {name: bad}),
        ),
        noise={name: 0.009},
        warnings=(Finding("clock", "The clock jitters.", "Keep its stamps."),),
        data={"samples": 3000, "step_s": 0.02, "notes": ["Line 9: a row was left out."]},
        rollouts=(
            Rollout(source, 3, 5, time, {name: gap}, {name: wave}, {action: wave}, at_stop=True),
        ),
        residuals=Residuals(time, {name: gap}, {name: wave}, {action: wave}, past, {name: [0.9]}),
        settings={"integrator": "rk4"},
        units={name: "rad"},
        seconds=1.5,
    )


def test_the_page_is_well_formed_and_has_every_part() -> None:
    page = report_page(sample(), title="A rod", lines={"in Python": "x = {'a': 1 < 2}"})
    reader = read(page)
    text = " ".join(" ".join(reader.text).split())
    for words in (
        "A rod", "The clock jitters.", "What to do: Keep its stamps.",
        "Line 9: a row was left out.", "✓ identified, ± 0.032 %",
        "◐ only in combination with drag", "Spin it.",
        "✗ not identified by these data", "▲ at its limit", "■ fixed",
        "gain / drag", "0.3099 to 0.3101",
        "2 steps (0.04 s)", "0.04 to 0.06", "delay 2, lag", "angle (rad), 20 steps", "1.2 ×",
        "stretches that meet a stop", "▲ 9 ×", "a.csv, episode 3", "which meets a stop",
        "against volts 2 before",
        "x = {'a': 1 < 2}",
    ):  # fmt: skip
        assert words in text, words
    assert text.index("The clock jitters.") < text.index("first guess"), "warnings come first"


def test_the_page_needs_nothing_from_elsewhere() -> None:
    page = report_page(sample())
    reader = read(page)
    assert {tag for tag, _ in reader.tags} & {"script", "link", "img", "iframe", "object"} == set()
    for tag, attributes in reader.tags:
        for name in ("src", "href", "xlink:href", "data", "action", "srcset"):
            assert (attributes.get(name) or "#").startswith("#"), (tag, attributes)
        assert not any(name.startswith("on") for name in attributes), (tag, attributes)
    assert not re.search(r"https?:|//|url\(|@import|javascript:", page)
    assert "default-src 'none'" in page
    assert len(page) < 1_000_000


def test_links_and_pictures_can_be_followed_and_heard() -> None:
    reader = read(report_page(sample()))
    ids = [a["id"] for _, a in reader.tags if "id" in a]
    assert len(ids) == len(set(ids))
    for tag, attributes in reader.tags:
        if tag == "a":
            assert str(attributes["href"])[1:] in ids
        if tag == "svg":
            assert attributes["role"] == "img"
            assert len(str(attributes["aria-label"])) > 10
        if tag == "th":
            assert attributes["scope"] in ("row", "col")
        if tag == "section":
            assert attributes["aria-labelledby"] in ids
    assert [tag for tag, _ in reader.tags].count("h1") == 1
    assert ("html", {"lang": "en"}) in reader.tags


@pytest.mark.parametrize("where", ["state", "action", "source", "constant", "warning", "title"])
def test_names_are_text_whatever_is_in_them(where: str) -> None:
    given = {"state": "name", "action": "action", "source": "source"}
    found = sample(**{given[where]: EVIL}) if where in given else sample()
    title = "plain"
    if where == "constant":
        verdict = f"only in combination with {EVIL}"
        found = replace(found, constants={EVIL: Estimate(1.0, 1.0, None, None, verdict, EVIL)})
    if where == "warning":
        found = replace(found, warnings=(Finding("x", EVIL, EVIL),), data={"notes": [EVIL]})
    if where == "title":
        title = EVIL
    page = report_page(found, title=title, lines={EVIL: EVIL})
    reader = read(page)
    assert "script" not in {tag for tag, _ in reader.tags}
    assert EVIL in unescape("".join(reader.text))


def test_an_identification_with_little_in_it_has_a_page_too() -> None:
    empty = Identification({}, {}, ActuatorEstimate(), {}, (), {}, (), {})
    text = " ".join(read(report_page(empty)).text)
    assert "nothing speaks against these numbers" in text
    assert "nothing was predicted" in text
    assert "acts at once" in text


def test_warnings_with_one_advice_share_it() -> None:
    twice = tuple(Finding("unknown", f"{n} is unknown.", "Move it.") for n in ("a", "b"))
    text = " ".join(read(report_page(replace(sample(), warnings=twice))).text)
    assert text.count("Move it.") == 1
    assert "a is unknown." in text
    assert "b is unknown." in text


def test_a_chart_draws_what_it_is_given() -> None:
    x: list[float | None] = [0.0, 1.0, 2.0, 3.0]
    svg = chart([Series(x, [1.0, None, 1.0, 2.0], "line", "model")], "a gap", "x", "y")
    path = re.findall(r'class="line model" d="([^"]*)"', svg)[0]
    assert path.count("M") == 2, "a line is not drawn over a gap"
    flat = chart([Series(x, [5.0] * 4, "dots", "model")], "flat", "x", "y")
    assert "nan" not in flat
    assert flat.count("h0") == 4
    assert "nan" not in chart([], "nothing", "x", "y")


def test_an_interval_too_small_to_see_has_a_width() -> None:
    width = re.findall(r'<rect class="interval"[^>]* width="([\d.]+)"', interval_bar(1, 2, 2, 2))
    assert float(width[0]) == 3.0
    assert thin(1000, 10)[0] == 0
    assert thin(1000, 10)[-1] == 999


class Rod(System):
    state_names, action_names = ("angle",), ("volts",)
    default_constants = {
        "mass": 0.3,
        "gain": 1.0,
        "drag": 0.1,
        "tilt": Constant(0.1, low=-0.2, high=0.2),
        "gravity": Constant(9.81, fixed=True),
    }


def test_what_is_pasted_is_python_and_makes_the_fitted_task() -> None:
    box = Box((0.0,), (1.0,))
    task = Task("rod", Rod(), (1.0,), 0.01, 10, box, lambda s, a, n: s[..., 0])
    found = replace(sample(), stops={"angle": (-math.inf, 0.4)})
    lines = ready_to_paste(task, found)
    names = {"Constant": Constant, "Actuator": Actuator}
    exec(lines["Rod, in Python"], names)
    constants = names["default_constants"]
    assert constants["mass"] == 0.31  # type: ignore[index]
    assert constants["tilt"] == Constant(0.1996, low=-0.2, high=0.2)  # type: ignore[index]
    assert constants["gravity"] == Constant(9.81, fixed=True)  # type: ignore[index]
    given = eval(f"dict({lines['Task(...), in Python']})", names)
    actuator = given["actuator"]
    assert given["position_limits"] == {"angle": (-math.inf, 0.4)}
    assert actuator == Actuator(delay_steps=4.0, lag=0.05), "in steps of the task, half as long"
    assert (
        lines["the actuator in the settings of rod, in YAML"]
        == "actuator: {delay_steps: 4.0, lag: 0.05}"
    )
