"""The list of worlds, each with the fits that are compared on its data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from other_worlds import from_dm_control, from_gymnasium
from phihp_torchrl import Task
from phihp_torchrl.systems import CartPole


@dataclass(frozen=True)
class Fit:
    """One way to fit the data of a world.

    Args:
        task: the task, as far as this fit knows it.
        model: settings of the model that differ from the defaults.
        robust: threshold of the robust loss; ``None`` for squares.
    """

    task: Task
    model: Mapping[str, Any] = field(default_factory=dict)
    robust: float | None = None


@dataclass(frozen=True)
class OtherWorld:
    """A world, what is told of it, and what is compared.

    Args:
        task: the task as told.
        make_env: makes an environment.
        repeat: steps of the environment in a step of the task.
        model: settings of the model as told.
        stops: lowest and highest position between the stops, by name, for the measurement.
        others: other fits of the same data, by name.
    """

    task: Task
    make_env: Callable[[], Any]
    repeat: int = 1
    model: Mapping[str, Any] = field(default_factory=dict)
    stops: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    others: Mapping[str, Fit] = field(default_factory=dict)


_EULER = {"integrator": "semi_implicit_euler"}
_RK4 = {"integrator": "rk4", "substeps": 2}
_RAIL = {"x": (-from_dm_control.RAIL, from_dm_control.RAIL)}
_TEXTBOOK = replace(
    from_dm_control.CARTPOLE,
    system=CartPole({"gravity": 9.81, "cart_mass": 1.3, "pole_mass": 0.07, "half_length": 0.65}),
)
_CAR = from_gymnasium.MOUNTAIN_CAR
_OPEN_CAR = replace(_CAR, position_limits={})

WORLDS = {
    "dm_control cartpole": OtherWorld(
        from_dm_control.CARTPOLE,
        from_dm_control.cartpole_env,
        repeat=2,
        model=_RK4,
        stops=_RAIL,
        others={
            "default settings, no stops": Fit(_TEXTBOOK),
            "no stops": Fit(_TEXTBOOK, _RK4),
            "no stops, robust loss": Fit(_TEXTBOOK, _RK4, robust=2.0),
            "hard stops": Fit(replace(_TEXTBOOK, position_limits=_RAIL), _RK4),
        },
    ),
    **{
        f"dm_control cartpole {name}": OtherWorld(
            task,
            partial(from_dm_control.cartpole_env, name.replace(" ", "_")),
            repeat=2,
            model=_RK4,
            stops=_RAIL,
        )
        for name, task in (
            ("balance", from_dm_control.BALANCE),
            ("balance sparse", from_dm_control.BALANCE_SPARSE),
            ("swingup sparse", from_dm_control.SPARSE),
        )
    },
    "dm_control pendulum": OtherWorld(
        from_dm_control.PENDULUM,
        from_dm_control.pendulum_env,
        repeat=2,
        model=_EULER | {"substeps": 2},
        others={"default settings": Fit(from_dm_control.PENDULUM)},
    ),
    "dm_control acrobot": OtherWorld(
        from_dm_control.ACROBOT,
        from_dm_control.acrobot_env,
        repeat=2,
        model={"integrator": "rk4"},
        others={"default settings": Fit(from_dm_control.ACROBOT)},
    ),
    "gymnasium MountainCarContinuous-v0": OtherWorld(
        _CAR,
        from_gymnasium.mountain_car_env,
        model=_EULER,
        stops={"x": (-1.2, 0.6)},
        others={
            "no stops": Fit(_OPEN_CAR),
            "no stops, robust loss": Fit(_OPEN_CAR, robust=2.0),
        },
    ),
    "gymnasium MountainCarContinuous-v0 as it is": OtherWorld(
        from_gymnasium.PLAIN_CAR,
        from_gymnasium.plain_car_env,
        model=_EULER,
        stops={"x": (-1.2, 0.6)},
    ),
    "gymnasium Pendulum-v1": OtherWorld(
        from_gymnasium.PENDULUM_V1, from_gymnasium.pendulum_v1_env, model=_EULER
    ),
}
"""The worlds by name."""
