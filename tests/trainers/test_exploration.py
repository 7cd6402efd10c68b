"""What exploration never does: leave its amplitude, its rate, its band, or go on beyond a guard."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lopsided import LOPSIDED
from tensordict import TensorDict

from phihp_torchrl import HybridDynamics
from phihp_torchrl.config import ConfigError
from phihp_torchrl.trainers import ModelTrainer
from phihp_torchrl.trainers.collect import CollectConfig, planning_policy, random_policy
from phihp_torchrl.trainers.exploration import Exploration, ExplorationConfig, coloured_noise

from . import controllers
from .trainer_parts import COLLECT, MODEL, PENDULUM, SHORT

SMALL = {"max_examples": 15, "deadline": None}
HERE = "trainers.controllers"


def acted(policy, steps, task=PENDULUM, period=None):
    """The actions ``[steps, m]`` of a policy at random observations."""
    actions = []
    for step in range(steps):
        observation = task.observe(task.reset.sample([]))
        count = torch.tensor([step % (period or steps)])
        actions.append(policy(TensorDict(observation=observation, step_count=count))["action"])
    return torch.stack(actions)


def at_random(steps, task=PENDULUM, seed=0, period=None, **exploration):
    config = CollectConfig(exploration=ExplorationConfig(**exploration))
    generator = torch.Generator().manual_seed(seed)
    return acted(random_policy(task, config, generator), steps, task, period)


# Defaults


@pytest.mark.parametrize("hold", [1, 3])
def test_defaults_draw_what_was_always_drawn(hold):
    generator = torch.Generator().manual_seed(0)
    policy = random_policy(LOPSIDED, CollectConfig(random_hold=hold), generator)
    actions = acted(policy, 9, LOPSIDED)
    again, bounds = torch.Generator().manual_seed(0), LOPSIDED.bounds
    for step in range(9):
        if step % hold == 0:
            expected = bounds.from_unit(2.0 * torch.rand(1, generator=again) - 1.0)
        assert torch.equal(actions[step], expected)


# Amplitude and rate


@given(
    st.floats(0.01, 2.0),
    st.one_of(st.none(), st.floats(0.01, 100.0)),
    st.one_of(st.none(), st.floats(-6.0, 12.0, width=32)),
    st.one_of(st.none(), st.floats(0.2, 10.0)),
    st.integers(0, 99),
)
@settings(**SMALL)
def test_random_actions_stay_in_amplitude_bounds_and_rate(amplitude, rate, trim, bandwidth, seed):
    actions = at_random(
        60,
        LOPSIDED,
        seed,
        period=25,
        amplitude=amplitude,
        rate=rate,
        trim=None if trim is None else (trim,),
        bandwidth=bandwidth,
    )[:, 0]
    start = 3.0 if trim is None else trim
    assert ((actions >= -6) & (actions <= 12)).all()
    assert ((actions - start).abs() <= 9 * amplitude * (1 + 1e-5) + 1e-5).all()
    if rate is not None:
        for episode in (actions[:25], actions[25:50], actions[50:]):
            path = torch.cat([torch.tensor([start]), episode])
            assert (path.diff().abs() <= 9 * rate * 0.05 * (1 + 1e-4) + 1e-5).all()


@given(st.floats(0.05, 1.0), st.floats(0.1, 20.0), st.integers(0, 99))
@settings(max_examples=6, deadline=None)
def test_planned_actions_stay_in_amplitude_and_rate(amplitude, rate, seed):
    limits = ExplorationConfig(amplitude=amplitude, rate=rate, bandwidth=2.0)
    generator = torch.Generator().manual_seed(seed)
    config = replace(COLLECT, exploration=limits)
    dynamics = HybridDynamics.hybrid(PENDULUM)
    policy = planning_policy(PENDULUM, dynamics, config, generator, noise=2.0)
    actions = acted(policy, 20)[:, 0]
    assert (actions.abs() <= 2 * amplitude + 1e-6).all()
    path = torch.cat([torch.zeros(1), actions])
    assert (path.diff().abs() <= 2 * rate * 0.05 + 1e-5).all()
    assert actions.abs().max() > 0


def test_a_plan_knows_the_amplitude():
    around = ExplorationConfig(amplitude=0.25, trim=(10.0,))
    task = Exploration(LOPSIDED, around).planning_task()
    assert (task.action_low, task.action_high) == ((7.75,), (12.0,))


# Colour


@given(
    st.integers(40, 400),
    st.floats(0.005, 0.1),
    st.floats(0.2, 0.9),
    st.floats(0.0, 2.0),
    st.integers(0, 99),
)
@settings(**SMALL)
def test_there_is_no_power_above_the_bandwidth(length, time_step, share, colour, seed):
    bandwidth = share * 0.5 / time_step
    noise = coloured_noise(
        length,
        2,
        time_step,
        bandwidth=bandwidth,
        colour=colour,
        generator=torch.Generator().manual_seed(seed),
    )
    assert noise.abs().amax(0).tolist() == [1.0, 1.0]
    assert (noise.double().mean(0).abs() < 1e-6).all()
    power = torch.fft.rfft(noise.double(), dim=0).abs().square()
    above = torch.fft.rfftfreq(length, time_step, dtype=torch.float64) > bandwidth * 1.001
    assert (power[above].sum(0) < 1e-9 * power.sum(0)).all()


@pytest.mark.parametrize("colour", [0.0, 1.0, 2.0])
def test_power_falls_by_the_exponent(colour):
    generator = torch.Generator().manual_seed(1)
    noise = coloured_noise(4096, 16, 0.01, colour=colour, generator=generator).double()
    power = torch.fft.rfft(noise, dim=0).abs().square()[1:-1]
    power = (power / power.mean(0)).mean(1)
    frequency = torch.fft.rfftfreq(4096, 0.01, dtype=torch.float64)[1:-1]
    columns = torch.stack([frequency.log(), torch.ones_like(frequency)], -1)
    slope = torch.linalg.lstsq(columns, power.log().unsqueeze(-1)).solution[0].item()
    assert slope == pytest.approx(-colour, abs=0.05)


def test_slow_exploration_is_slow_in_the_world_and_goes_on_without_a_jump():
    slow = at_random(3 * PENDULUM.max_steps, bandwidth=0.5)[:, 0]
    white = at_random(200)[:, 0]
    assert slow.diff().abs().max() < 0.25 < white.diff().abs().mean()
    assert slow.abs().max() <= 2


# A controller


def test_it_explores_around_a_controller():
    config = ExplorationConfig(amplitude=0.1, controller=f"{HERE}:proportional")
    policy = random_policy(PENDULUM, CollectConfig(exploration=config), torch.Generator())
    for theta in (-1.0, 0.0, 2.0):
        observation = PENDULUM.observe(torch.tensor([theta, 0.0]))
        start = TensorDict(observation=observation, step_count=torch.tensor([0]))
        action = policy(start)["action"]
        assert (action - controllers.proportional(observation)).abs() <= 0.2 + 1e-6


def test_a_controller_with_a_memory_is_reset_with_each_episode():
    controllers.counting.resets = 0
    config = ExplorationConfig(amplitude=1e-9, controller=f"{HERE}:counting")
    policy = random_policy(PENDULUM, CollectConfig(exploration=config), torch.Generator())
    actions = acted(policy, 6, period=3)[:, 0]
    assert controllers.counting.resets == 2
    torch.testing.assert_close(actions, torch.tensor([1.0, 2, 3, 1, 2, 3]) / 1000)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("failing", "failing failed at step 0: ZeroDivisionError: division by zero"),
        ("of_two", "expected 1 finite numbers .*, for .'torque'., got tensor"),
        ("number", "expected a function, .*number is none"),
        ("missing", "cannot be imported: AttributeError"),
    ],
)
def test_a_controller_that_cannot_be_used_is_named(name, reason):
    controller = f"{HERE}:{name}"
    with pytest.raises(ConfigError, match=rf"exploration\.controller: .*{reason}"):
        at_random(1, controller=controller)


# Settings


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("amplitude", 0.0),
        ("amplitude", 2.5),
        ("amplitude", float("nan")),
        ("rate", 0.0),
        ("bandwidth", -1.0),
        ("colour", -1.0),
        ("controller", "rig.act"),
    ],
)
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(ConfigError, match=name):
        ExplorationConfig(**{name: value})


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"trim": (0.0, 1.0)}, r"trim: expected 1 values for \('torque',\)"),
        ({"trim": (9.0,)}, "trim: expected values within"),
        ({"bandwidth": 0.01}, "bandwidth: expected 0.1 Hz"),
        ({"bandwidth": 11.0}, "bandwidth: expected .* to 10 Hz"),
        ({"guards": {"angle": 1.0}}, r"guards\.angle: expected one of the states"),
        ({"guards": {"theta_dot": -1.0}}, r"guards\.theta_dot: expected a positive number"),
        ({"guards": {"theta_dot": 0.5}}, r"guards\.theta_dot: expected limits around .* reset"),
    ],
)
def test_what_does_not_fit_the_task_is_refused_before_any_step(change, reason):
    config = replace(MODEL, collect=replace(COLLECT, exploration=ExplorationConfig(**change)))
    with pytest.raises(ConfigError, match=rf"model\.collect\.exploration\.{reason}"):
        ModelTrainer(PENDULUM, config, seed=0)


def test_a_controller_has_a_trim_of_its_own_and_a_signal_is_not_held():
    with pytest.raises(ConfigError, match="trim: expected none beside a controller"):
        ExplorationConfig(trim=(0.0,), controller="rig:act")
    with pytest.raises(ConfigError, match="random_hold: expected 1 with"):
        CollectConfig(random_hold=2, exploration=ExplorationConfig(colour=1.0))


# Guards in a run


def test_a_guard_ends_episodes_and_is_told(caplog):
    guards = {"theta_dot": (-1.5, 1.5)}
    config = replace(MODEL, collect=replace(COLLECT, exploration=ExplorationConfig(guards=guards)))
    trainer = ModelTrainer(SHORT, config, seed=0)
    with caplog.at_level(logging.WARNING):
        metrics = trainer.advance()
    data, speed = trainer.data, trainer.data["next", "observation"][:, 2]
    beyond = speed.abs() > 1.5
    assert beyond.any()
    assert metrics["collect/guard_crossings"] == beyond.sum() == trainer.crossings.total()
    assert data["next", "done"][beyond].all()
    assert not data["next", "terminated"].any()
    assert (data["observation"][:, 2].abs() <= 1.5).all(), "no episode goes on beyond it"
    assert len(data) == 25, "the step that crosses is kept"
    assert "Guards ended" in caplog.text
    assert "theta_dot above 1.5" in caplog.text or "theta_dot below -1.5" in caplog.text
    assert "collect/guard_crossings" not in ModelTrainer(SHORT, MODEL, seed=0).advance()
