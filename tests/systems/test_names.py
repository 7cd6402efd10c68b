"""Names that do not fit together are told by the class, the attribute and the name."""

from __future__ import annotations

import pytest

from phihp_torchrl import Task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.systems import LagrangianSystem, System
from phihp_torchrl.tasks import Box
from phihp_torchrl.tasks.dry_run import check_functions

GOOD = {
    "state_names": ("angle", "speed"),
    "action_names": ("torque",),
    "angles": ("angle",),
    "velocity_of": {"angle": "speed"},
}
STATES = "expected some of the states ['angle', 'speed'], got "

wrong = pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"velocity_of": {"angle": "sped"}}, f"velocity_of: {STATES}'sped'; did you mean 'speed'?"),
        ({"velocity_of": {"angel": "speed"}}, f"velocity_of: {STATES}'angel'; did you mean 'an"),
        ({"velocity_of": ("angle", "speed")}, "velocity_of: expected velocities by position, got"),
        ({"angles": ("angel",)}, f"angles: {STATES}'angel'; did you mean 'angle'?"),
        ({"angles": ("zzz",)}, f"angles: {STATES}'zzz'."),
        ({"angles": ("angle", "angle")}, "angles: expected names of their own, got 'angle' twice."),
        ({"angles": "angle"}, "angles: expected a tuple of names, got 'angle'; a tuple of one is "
                              "('angle',)."),
        ({"state_names": ("angle", "angle")}, "state_names: expected names of their own, got "
                                              "'angle' twice."),
        ({"state_names": None}, "state_names: expected a tuple of names, got None."),
        ({"action_names": (1,)}, "action_names: expected a tuple of names, got (1,)."),
        ({"action_names": ("speed",)}, "action_names: expected names of their own, got 'speed' in "
                                       "state_names too."),
        ({"input_names": ("torque",)}, "input_names: expected names of their own, got 'torque' in "
                                       "action_names too."),
    ],
)  # fmt: skip


def make_task(system):
    return Task(
        name="arm",
        system=system,
        action_high=(1.0,),
        time_step=0.1,
        max_steps=5,
        reset=Box((0.0, 0.0), (0.1, 0.1)),
        reward=lambda state, action, next_state: -(next_state[..., 0] ** 2),
    )


@wrong
def test_a_task_refuses_a_system_whose_names_do_not_fit(change, message):
    arm = type("Arm", (System,), {**GOOD, **change})()
    for use in (make_task, System.layout):
        with pytest.raises(ConfigError) as error:
            use(arm)
        assert str(error.value).startswith(f"Arm.{message}")


@wrong
def test_a_lagrangian_is_not_derived_for_them(change, message):
    with pytest.raises(ConfigError) as error:
        type("Arm", (LagrangianSystem,), {**GOOD, **change})()
    assert str(error.value).startswith(f"Arm.{message}")


def test_names_that_fit_are_a_task():
    arm = type("Arm", (System,), {**GOOD, "input_names": ()})()
    task = make_task(arm)
    assert task.observation_dim == 3
    check_functions(task)
