"""Random trajectories stay in their range, and consist of the pieces that were asked for."""

from __future__ import annotations

import pytest
import torch

from phihp_torchrl.config import ConfigError
from phihp_torchrl.tasks import Trajectories

LOW, HIGH = (-1.0, 2.0), (3.0, 2.5)


def draw(seed: int = 0, shape=(16,), **shares):
    generator = torch.Generator().manual_seed(seed)
    sampler = Trajectories(hold=0.5, **shares)
    return sampler(shape, 400, 0.01, generator, low=LOW, high=HIGH)


@pytest.mark.parametrize("kind", ["steps", "ramps", "sines"])
def test_every_kind_stays_in_range_and_moves(kind):
    shares = {name: float(name == kind) for name in ("steps", "ramps", "sines")}
    drawn = draw(**shares)
    low, high = torch.tensor(LOW), torch.tensor(HIGH)
    assert drawn.shape == (16, 400, 2)
    assert (drawn >= low - 1e-5).all()
    assert (drawn <= high + 1e-5).all()
    assert (drawn.std(-2) > 0.01 * (high - low)).all()


def test_steps_stay_for_the_mean_duration():
    changes = (draw(ramps=0.0, sines=0.0, shape=(64,)).diff(dim=-2) != 0).float().mean()
    assert changes.item() == pytest.approx(0.01 / 0.5, rel=0.1)


def test_a_ramp_ends_where_the_next_piece_begins():
    width = torch.tensor(HIGH) - torch.tensor(LOW)
    far = {
        kind: (draw(**shares, shape=(64,)).diff(dim=-2).abs() > 0.5 * width).float().mean().item()
        for kind, shares in {
            "ramps": {"steps": 0.0, "sines": 0.0},
            "steps": {"ramps": 0.0, "sines": 0.0},
        }.items()
    }
    # A ramp moves by more than half its way in one step only if it lasts for one step.
    assert far["ramps"] < 0.1 * far["steps"]
    assert (draw(steps=0.0, sines=0.0).diff(dim=-2) != 0).float().mean() > 0.8


def test_a_seed_gives_the_same_trajectories():
    assert draw(seed=3).equal(draw(seed=3))
    assert not draw(seed=3).equal(draw(seed=4))


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        ({"hold": 0.0}, "hold"),
        ({"ramps": -1.0}, "ramps"),
        ({"period": 0.0}, "period"),
        ({"steps": 0.0, "ramps": 0.0, "sines": 0.0}, "steps"),
    ],
)
def test_wrong_settings_are_refused_by_name(settings, key):
    with pytest.raises(ConfigError, match=f"^{key}: "):
        Trajectories(**settings)
