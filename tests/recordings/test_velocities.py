"""Velocities estimated from positions: accuracy, noise levels, clocks, gaps and stops."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from phihp_torchrl import System
from phihp_torchrl.config import ConfigError
from phihp_torchrl.recordings import Recording, estimate_velocities
from phihp_torchrl.recordings.kalman import Series, backward, filter_forward
from tests.recordings.log_parts import Rig


class Slider(System):
    state_names, action_names = ("x", "v"), ("force",)
    velocity_of = {"x": "v"}


def log(time: np.ndarray, position: np.ndarray) -> Recording:
    state = torch.from_numpy(np.stack([position, np.full_like(position, np.nan)], -1))
    return Recording(torch.from_numpy(time), state, torch.zeros(len(time), 1))


def driven(count: int = 800, step: float = 0.02, seed: int = 0) -> tuple[np.ndarray, ...]:
    """A mass with friction under forces that are held for a step: time, position, velocity."""
    draw = np.random.default_rng(seed)
    force = np.repeat(draw.uniform(-3.0, 3.0, count // 10 + 1), 10)[:count]
    x = v = 0.0
    path = []
    for push in force:
        path.append((x, v))
        a = push - 0.5 * v
        x, v = x + step * v + 0.5 * step**2 * a, v + step * a
    return step * np.arange(count), *np.array(path).T


def rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(error))))


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
def test_the_sensor_noise_is_found_and_velocities_beat_differences(noise: float) -> None:
    time, x, v = driven()
    seen = x + noise * np.random.default_rng(1).normal(size=len(x))
    estimate = estimate_velocities(log(time, seen), Slider())
    found = estimate.found["x"]
    assert found.noise == pytest.approx(noise, rel=0.15)
    error = rms(estimate.recordings[0].state[:, 1].numpy() - v)
    assert error < 0.2 * rms(np.gradient(seen, time) - v) + 0.02
    assert 0.5 < error / found.velocity_error < 2.0  # it knows how good it is
    assert estimate.recordings[0].state[:, 0].tolist() == seen.tolist()


def test_smoothed_positions_are_better_than_measured_ones_and_fill_gaps() -> None:
    time, x, _ = driven()
    seen = x + 1e-2 * np.random.default_rng(1).normal(size=len(x))
    seen[100:103] = np.nan
    estimate = estimate_velocities(log(time, seen), Slider(), smooth_positions=True)
    assert rms(estimate.recordings[0].state[:, 0].numpy() - x) < 0.6 * rms(seen - x)
    assert estimate.recordings[0].state.isfinite().all()


@settings(max_examples=10)
@given(st.integers(0, 1000))
def test_an_irregular_clock_and_missing_samples_cost_little(seed: int) -> None:
    draw = np.random.default_rng(seed)
    time = np.cumsum(draw.uniform(0.01, 0.1, 150))
    phase = draw.uniform(0.0, math.tau)
    seen = np.sin(time + phase) + 1e-3 * draw.normal(size=150)
    seen[draw.random(150) < 0.1] = np.nan
    found = estimate_velocities(log(time, seen), Slider()).recordings[0].state[:, 1].numpy()
    inner = slice(5, -5)
    assert rms((found - np.cos(time + phase))[inner]) < 0.03


def test_a_sine_of_a_quantised_encoder() -> None:
    time = 0.02 * np.arange(600)
    count = math.tau / 2048
    seen = np.round(2.0 * np.sin(3.0 * time) / count) * count
    estimate = estimate_velocities(log(time, seen), Slider())
    assert estimate.found["x"].noise == pytest.approx(count / math.sqrt(12), rel=0.2)
    assert rms(estimate.recordings[0].state[:, 1].numpy() - 6.0 * np.cos(3.0 * time)) < 0.05


def test_a_velocity_that_jumps_is_left_unknown_there_and_good_elsewhere() -> None:
    step, x, v, path = 0.01, 0.0, 1.0, []
    for _ in range(800):  # a puck between two walls that take half of its speed, and a push
        path.append((x, v))
        x, v = x + step * v, v + step * math.copysign(2.0, v) * (abs(v) < 1.0)
        if abs(x) > 0.4:
            x, v = math.copysign(0.8, x) - x, -0.5 * v
    time, (positions, speeds) = step * np.arange(800), np.array(path).T
    seen = positions + 3e-4 * np.random.default_rng(0).normal(size=800)
    estimate = estimate_velocities(log(time, seen), Slider())
    hits = int((np.diff(np.sign(speeds)) != 0).sum())
    assert 0.8 * hits <= estimate.found["x"].jumps <= 1.3 * hits
    assert "velocity jumps" in estimate.notes()[0]
    error = estimate.recordings[0].state[:, 1].numpy() - speeds
    smeared = estimate_velocities(log(time, seen), Slider(), keep_jumps=True)
    assert smeared.recordings[0].state.isfinite().all()
    assert rms(error) < 0.4 * rms(smeared.recordings[0].state[:, 1].numpy() - speeds)
    assert 0.8 < estimate.found["x"].noise / 3e-4 < 1.25


def test_recordings_are_smoothed_apart_and_short_ones_get_none() -> None:
    time, x, _ = driven()
    whole = [log(time[:400], x[:400]), log(time[400:], x[400:] + 100.0), log(time[:4], x[:4])]
    found = estimate_velocities(whole, Slider()).recordings
    assert all(r.state[:, 1].abs().max() < 20.0 for r in found[:2])  # no jump of 100 in between
    assert found[2].state[:, 1].isnan().all()
    with pytest.raises(ConfigError, match="at least 5 measured samples of 'x'"):
        estimate_velocities(whole[2], Slider())


def test_a_velocity_that_was_measured_stays() -> None:
    state = torch.randn(20, 4).double()
    state[:, 3] = torch.nan
    recording = Recording(torch.arange(20), state, torch.zeros(20, 1))
    estimate = estimate_velocities([recording], Rig())
    assert list(estimate.found) == ["angle"]
    assert torch.equal(estimate.recordings[0].state[:, :3], state[:, :3])


def test_the_smoother_is_the_mean_of_the_gaussian_that_its_model_says() -> None:
    """Against a dense solution: x = prior covariance of white jerk, a quadratic left free."""
    draw = np.random.default_rng(0)
    time = np.cumsum(draw.uniform(0.5, 1.5, 12))
    time -= time[0]
    z = draw.normal(size=12)
    ratio = 0.3
    # Covariance of twice integrated white jerk between times s <= t.
    s, t = np.minimum.outer(time, time), np.maximum.outer(time, time)
    cover = ratio * (s**5 / 20 + (t - s) * s**4 / 8 + (t - s) ** 2 * s**3 / 12)
    free = np.stack([np.ones(12), time, time**2 / 2], -1)
    inverse = np.linalg.inv(cover + np.eye(12))
    weights = np.linalg.solve(free.T @ inverse @ free, free.T @ inverse @ z)
    expected = free @ weights + cover @ inverse @ (z - free @ weights)
    series = Series(time, z)
    found = filter_forward(series, np.zeros(12, dtype=bool), 1.0, ratio, keep=True)
    path, _ = backward(series, found, 1.0)
    assert np.allclose(path[:, 0], expected, atol=1e-5)
