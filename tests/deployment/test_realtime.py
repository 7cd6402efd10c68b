"""Control loops keep time, or say that they do not."""

from __future__ import annotations

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from lopsided import LOPSIDED
from tensordict.nn import TensorDictModule

from phihp_torchrl import get_task, save_agent
from phihp_torchrl.deployment import Controller, run_realtime

from .agent_parts import make_agent

RECIPE = Path(__file__).parents[2] / "recipes" / "realtime.py"


class FakeTime:
    """A clock that only sleeping and acting move."""

    def __init__(self, durations):
        self.now, self.durations = 100.0, iter(durations)

    def clock(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds

    def policy(self):
        def act(observation):
            self.now += next(self.durations)
            return torch.ones(1)

        return TensorDictModule(act, ["observation"], ["action"])


def test_deadlines():
    # At 10 Hz: in time, two and a half periods late, and in time again.
    time = FakeTime([0.01, 0.25, 0.02, 0.03, 0.01, 0.01])
    report = run_realtime(
        time.policy(),
        get_task("pendulum"),
        rate=10,
        seconds=0.6,
        seed=0,
        clock=time.clock,
        sleep=time.sleep,
    )
    assert report.missed == 2
    # The action after the late one starts half a period after its tick.
    expected = [10.0, 250.0, 50.0 + 20.0 - 50.0, 30.0]
    assert report.milliseconds[:2].tolist() == pytest.approx(expected[:2])
    assert len(report.milliseconds) == 4
    assert time.now == pytest.approx(100.0 + 0.5 + report.milliseconds[-1].item() / 1e3)


@pytest.mark.parametrize("task", ["pendulum", LOPSIDED])
def test_the_world_does_not_wait(task):
    """Late actions or not, the world has gone through the same time."""
    steps = []
    task = task if task is LOPSIDED else get_task(task)

    def reward(state, action, next_state):
        steps.append(action.item())
        return torch.zeros(())

    time = FakeTime([0.25, 0.01, 0.01])
    run_realtime(
        time.policy(), replace(task, reward=reward), rate=10, seconds=0.5, seed=0,
        clock=time.clock, sleep=time.sleep,
    )  # fmt: skip
    middle = task.bounds.center.item()
    assert steps == [middle, middle, 1.0, 1.0, 1.0], "the first two ticks had no action yet"


def test_a_controller_in_the_loop_says_who_acted():
    time = FakeTime([0.01] * 5)
    control = Controller(
        time.policy(), "pendulum", accept=lambda o, a: abs(o[2]) > 0.0, fallback="zero"
    )
    options = {"clock": time.clock, "sleep": time.sleep}
    report = run_realtime(control, "pendulum", rate=10, seconds=0.5, seed=0, **options)
    assert report.control.steps == 5
    assert report.control.overruled == 0
    control._accept = lambda o, a: False
    time.durations = iter([0.01] * 5)
    report = run_realtime(control, "pendulum", rate=10, seconds=0.5, seed=0, **options)
    assert report.control.reasons == {"refused": 5}


def test_the_same_seed_starts_in_the_same_state():
    def mean_reward(seed):
        time = FakeTime([0.01] * 5)
        clocks = {"clock": time.clock, "sleep": time.sleep}
        report = run_realtime(time.policy(), "pendulum", rate=10, seconds=0.5, seed=seed, **clocks)
        assert report.missed == 0
        return report.mean_reward

    assert mean_reward(1) == mean_reward(1)
    assert mean_reward(1) != mean_reward(2)


@pytest.mark.parametrize("name", ["rate", "seconds"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("inf"), float("nan")])
def test_bad_rates(name, value):
    options = {"rate": 10.0, "seconds": 1.0, "seed": 0, name: value}
    with pytest.raises(ValueError, match=f"^{name}:"):
        run_realtime(FakeTime([]).policy(), get_task("pendulum"), **options)


def test_realtime_recipe(tmp_path, monkeypatch, capsys):
    save_agent(make_agent(), tmp_path / "agent")
    arguments = [tmp_path / "agent", "--rates", 20, "--seconds", 0.3, "--eager"]
    monkeypatch.setattr(sys, "argv", ["realtime.py", *map(str, arguments)])
    runpy.run_path(str(RECIPE), run_name="__main__")
    assert "| 20 |" in capsys.readouterr().out
