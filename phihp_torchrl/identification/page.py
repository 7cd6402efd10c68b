"""An identification as one page of HTML that needs no network, no script and no other file."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from phihp_torchrl.display import cautions, facts, html_page, said
from phihp_torchrl.identification import sections
from phihp_torchrl.identification.charts import residual_charts, rollout_charts
from phihp_torchrl.identification.parts import FIXED, IDENTIFIED
from phihp_torchrl.identification.result import Identification

_ABOUT_CONSTANTS = (
    "The ring is the first guess, the dot the estimate, and the bar the 95 % interval, each row on "
    "its own scale. An interval says how far the noise of these data leaves a constant open, if "
    "the equations are right."
)
_ABOUT_ACTUATOR = (
    "What happens to a command before it acts. A part is kept only where it clearly lowers the "
    "error on windows that it was not fitted to, or on all of them, at a price, where they are "
    "few. The cost is the mean square residual of those windows in squares of the noise: one means "
    "that only noise is left. What is late by another time and not clearly worse is as good."
)
_ABOUT_ERRORS = (
    "Predictions of stretches that took no part in the fit, each begun from the samples before it. "
    "The error is the root mean square in the unit of the state. As a share of the change, 100 % "
    "is as bad as saying that nothing moves; as a multiple of the noise, 1 is all that a sensor "
    "can show. What is above twice the noise is marked ▲."
)
_ABOUT_REGIONS = (
    "The same at the longest horizon, by where a prediction begins: error, and times the noise. A "
    "region with few stretches was hardly seen."
)
_ABOUT_ROLLOUTS = (
    '<span class="key">measured</span> <span class="key model">the model</span> '
    '<span class="key command">command</span> <span class="key shade">predicted</span>. Left of '
    "the shade the model was fitted to the samples, and from there on it sees the commands alone. "
    "Time counts from the last sample that it knew."
)
_ABOUT_RESIDUALS = (
    "What the fitted trajectories leave over. Dots are samples (a part of them, evenly chosen), "
    "the line is the mean of each tenth, and the shade is one standard deviation of the noise. A "
    "line that leaves the shade shows what the equations miss: over a state, a force; over a "
    "command before, a delay or a lag. The charts cut off the largest hundredth."
)


def report_page(
    found: Identification,
    *,
    title: str = "Identification",
    lines: Mapping[str, str] | None = None,
) -> str:
    """Write an identification as a page of HTML.

    The page has its style and its pictures in itself, asks no network for anything, and has no
    script. It fits wide and narrow screens and paper, and follows a reader's light or dark.

    Args:
        found: the identification; ``data["notes"]`` may have sentences on what was left out.
        title: what was identified.
        lines: code that is ready to be pasted, by where it belongs.

    Returns:
        The text of the page.

    Examples:
        >>> from phihp_torchrl.identification.parts import ActuatorEstimate, Estimate
        >>> found = Identification(
        ...     constants={"mass": Estimate(1.0, 1.2, 1.19, 1.21)}, combinations={},
        ...     actuator=ActuatorEstimate(delay_steps=2.0), errors={}, regions=(),
        ...     noise={"angle": 0.01}, warnings=(), data={"samples": 3000},
        ... )
        >>> page = report_page(found, title="my <rig>")
        >>> page[:15], "my &lt;rig&gt;" in page, "identified, ±" in page
        ('<!doctype html>', True, True)
    """
    parts = {
        "warnings": ("Warnings", _warnings(found)),
        "data": ("What was read", _data(found)),
        "constants": ("Constants", _constants(found)),
        "actuator": ("Actuator", _actuator(found)),
        "errors": ("Errors of predictions", _errors(found)),
        "rollouts": ("Predicted and measured", said(_ABOUT_ROLLOUTS, rollout_charts(found))),
        "residuals": ("Residuals", said(_ABOUT_RESIDUALS, residual_charts(found))),
        "noise": ("Noise", sections.noise(found)),
        "use": ("To use it", _lines(lines or {})),
    }
    return html_page(title, _tiles(found), parts)


def _tiles(found: Identification) -> list[tuple[str, str]]:
    """The page in four numbers."""
    judged = [c for c in found.constants.values() if c.verdict != FIXED]
    told = sum(c.verdict == IDENTIFIED for c in judged)
    tiles = [(f"{told} of {len(judged)}", "constants are identified one by one")]
    if found.combinations:
        good = sum(c.verdict == IDENTIFIED for c in found.combinations.values())
        tiles.append((f"{good} of {len(found.combinations)}", "combinations are identified"))
    a = found.actuator
    path = [f"{n.replace('_steps', '')} {sections.number(v)} steps"
            for n, v in a.rows("delay_steps").items() if v]  # fmt: skip
    path += [f"{n.replace('_s', '')} {sections.number(v)} s"
             for n, v in a.rows("lag_s").items() if v]  # fmt: skip
    rest = [a.slew is not None and "rate limit", a.dead_zone and "dead zone",
            a.gain_low != 1.0 and "unequal gains"]  # fmt: skip
    path += [str(part) for part in rest if part]
    tiles.append((", ".join(path) or "acts at once", "the path of a command"))
    if found.errors:
        steps = max(found.errors, key=int)
        ratio = sections.number(found.errors[steps].floor_ratio, 3)
        tiles.append((f"{ratio} × noise", f"error {steps} steps ahead"))
    count = len(found.warnings)
    tiles.append((str(count) if count else "none", "warning" if count == 1 else "warnings"))
    return tiles


def _warnings(found: Identification) -> str:
    if not found.warnings:
        return "<p>None: nothing speaks against these numbers.</p>\n"
    return cautions((warning.text, warning.advice) for warning in found.warnings)


def _data(found: Identification) -> str:
    elsewhere = ("noise_without_model", "notes")
    read = {k: v for k, v in found.data.items() if k not in elsewhere}
    settings = {**found.settings, "stops": found.stops, "seconds of the fit": found.seconds}
    items = "".join(f"<li>{escape(note)}</li>" for note in found.data.get("notes", ()))
    told = f"<h3>What was left out, and why</h3>\n<ul>{items}</ul>\n" if items else ""
    return f"{facts(read)}{told}<h3>How it was fitted</h3>\n{facts(settings)}"


def _constants(found: Identification) -> str:
    html = sections.estimates(found, found.constants, "Constants")
    if found.combinations:
        html += "<h3>Combinations of constants</h3>\n"
        html += sections.estimates(found, found.combinations, "Combinations of constants")
    if found.restitution:
        caption = "Share of the speed that is left at the stops of a position"
        html += sections.estimates(found, found.restitution, caption)
    return said(_ABOUT_CONSTANTS, html)


def _actuator(found: Identification) -> str:
    tried = sections.tried_paths(found)
    more = f"<h3>What was tried</h3>\n{tried}" if tried else ""
    return said(_ABOUT_ACTUATOR, sections.actuator_parts(found) + more)


def _errors(found: Identification) -> str:
    if not found.errors:
        return "<p>No stretch was long enough to be held out, so nothing was predicted.</p>\n"
    where = sections.regions(found)
    more = f"<h3>By regions</h3>\n<p>{_ABOUT_REGIONS}</p>\n{where}" if where else ""
    return said(_ABOUT_ERRORS, sections.horizons(found) + more)


def _lines(lines: Mapping[str, str]) -> str:
    return "".join(
        f'<h3>{escape(place)}</h3>\n<pre tabindex="0">{escape(text)}</pre>\n'
        for place, text in lines.items()
    )
