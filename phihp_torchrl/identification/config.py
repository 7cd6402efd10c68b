"""Settings of an identification."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from phihp_torchrl.config import ConfigError, check_choice, check_count, check_fields, is_whole

Auto = Literal["auto"]
AUTO: Auto = "auto"


@dataclass(frozen=True)
class IdentifyConfig:
    """How recordings are fitted.

    What is ``"auto"`` is tried, and kept only where it clearly lowers the error on windows that
    took no part in that trial.

    Args:
        window: samples in a fitted window, whose start is free; fewer in short recordings.
        windows: windows that are fitted at most, spread over the recordings.
        past: samples before a prediction, from which its start is estimated; where stretches are
            short, half of them has to do.
        horizons: steps ahead at which predictions are judged.
        delay: dead time of the actions in steps of the recordings, or ``"auto"``.
        largest_delay: the longest delay that is tried.
        lag: time constant of the actuator in seconds, or ``"auto"``; 0 for none.
        slew: largest rate of the actuator in units of the action per second, or ``"auto"``; 0 for
            no limit.
        dead_zone: size of commands without effect, or ``"auto"``.
        gain_low: gain of negative commands, or ``"auto"``; 1 for that of positive ones.
        integrator: ``"rk4"``, ``"semi_implicit_euler"`` or ``"auto"``.
        substeps: steps of the integrator from one sample to the next; 0 to choose them.
        stops: by the name of a position, its lowest and highest value; samples there are left out.
            Stops of the task are known without, others are looked for.

    Raises:
        ConfigError: for a value out of range, by its name.

    Examples:
        >>> IdentifyConfig(delay=2.0, lag=0.0).largest_delay
        5
    """

    window: int = 80
    windows: int = 150
    past: int = 50
    horizons: tuple[int, ...] = (1, 5, 20)
    delay: float | Auto = AUTO
    largest_delay: int = 5
    lag: float | Auto = AUTO
    slew: float | Auto = AUTO
    dead_zone: float | Auto = AUTO
    gain_low: float | Auto = AUTO
    integrator: Literal["auto", "rk4", "semi_implicit_euler"] = AUTO
    substeps: int = 0
    stops: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self)
        check_count(self, "window", "past", least=8)
        check_count(self, "windows", least=4)
        check_count(self, "largest_delay", "substeps", least=0)
        check_choice(self, "integrator", choices=(AUTO, "rk4", "semi_implicit_euler"))
        horizons = self.horizons
        if not horizons or not all(is_whole(h, 1) for h in horizons):
            raise ConfigError("horizons", f"expected whole numbers of at least 1, got {horizons}.")
        object.__setattr__(self, "horizons", tuple(sorted(set(horizons))))
        for name in ("delay", "lag", "slew", "dead_zone", "gain_low"):
            value = getattr(self, name)
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            good = number and (value > 0 if name == "gain_low" else value >= 0)
            if value != AUTO and not good:
                raise ConfigError(
                    name, f"expected {AUTO!r} or a number of at least 0, got {value!r}."
                )
