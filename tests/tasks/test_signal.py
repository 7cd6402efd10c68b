"""A signal's registers: reading, shifting, windows, and what is refused."""

from __future__ import annotations

import pytest
import torch

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Signal, Trajectories

PAIR = Signal(("x", "y"), low=(-1.0, 0.0), high=(1.0, 4.0), preview=2)


def test_shifting_windows_are_the_windows_of_later_steps():
    trajectory = torch.arange(12.0).view(6, 2)
    registers = PAIR.window(trajectory, 0)
    for step in range(1, 4):
        registers = PAIR.shift(registers, trajectory[step + PAIR.preview])
        assert registers.equal(PAIR.window(trajectory, step))
        assert PAIR.value(registers).equal(trajectory[step])


def test_what_is_not_known_stays_as_it_is():
    registers = PAIR.window(torch.arange(6.0).view(3, 2), 0)
    for _ in range(3):
        registers = PAIR.shift(registers)
    assert registers.tolist() == [4.0, 5.0] * 3
    assert PAIR.window(torch.arange(6.0).view(3, 2), 7).tolist() == [4.0, 5.0] * 3


def test_a_value_without_preview_is_taken_to_stay():
    given = torch.tensor([[0.5, 1.0], [0.25, 2.0]])
    registers = PAIR.read(given, "reference", [2])
    assert registers.view(2, 3, 2).equal(given[:, None].expand(2, 3, 2))
    whole = torch.randn(2, 3, 2)
    assert PAIR.read(whole, "reference", [2]).equal(whole.flatten(-2))


@pytest.mark.parametrize("shape", [(3,), (2, 2), (4, 2), (3, 2, 1)])
def test_a_wrong_shape_is_refused_by_its_key(shape):
    with pytest.raises(ValueError, match=r"^wind: expected \('x', 'y'\) of shape \[2\], or with"):
        PAIR.read(torch.zeros(shape), "wind", [])


def test_values_that_are_not_finite_are_refused_by_their_key():
    with pytest.raises(ValueError, match=r"^wind: expected finite"):
        PAIR.read(torch.tensor([0.0, torch.nan]), "wind", [])


def test_scales_repeat_for_every_row():
    center, scale = PAIR.scales(torch.zeros(1))
    assert center.tolist() == [0.0, 2.0] * 3
    assert scale.tolist() == [1.0, 2.0] * 3


def test_a_sampler_of_ones_own_is_checked():
    still = Signal(("x",), (-1.0,), (1.0,), sampler=lambda shape, steps, *_: torch.zeros(1))
    with pytest.raises(ValueError, match=r"^sampler: expected shape \[5, 7, 1\]"):
        still.draw([5], 7, 0.1)
    ramp = Signal(
        ("x",),
        (-1.0,),
        (1.0,),
        sampler=lambda shape, steps, seconds, generator=None: (
            seconds * torch.arange(steps).view(-1, 1).expand(*shape, -1, -1)
        ),
    )
    assert ramp.draw([2], 3, 0.5).tolist() == [[[0.0], [0.5], [1.0]]] * 2


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"names": ()}, "names"),
        ({"names": ("x", "x")}, "names"),
        ({"low": (0.0,)}, "low"),
        ({"high": (1.0, float("inf"))}, "low"),
        ({"low": (1.0, 0.0)}, "low"),
        ({"preview": -1}, "preview"),
        ({"preview": 1.5}, "preview"),
        ({"sampler": 3}, "sampler"),
    ],
)
def test_wrong_settings_are_refused_by_name(settings, key):
    given = {"names": ("x", "y"), "low": (-1.0, -1.0), "high": (1.0, 1.0), **settings}
    with pytest.raises(ConfigError, match=f"^{key}: "):
        Signal(**given)


def test_its_config_has_what_an_agent_depends_on():
    assert PAIR.config == {
        "names": ["x", "y"],
        "low": [-1.0, 0.0],
        "high": [1.0, 4.0],
        "preview": 2,
    }
    other = Signal(**PAIR.config, sampler=Trajectories(hold=3.0))
    assert other.config == PAIR.config
