"""How long an action takes."""

from __future__ import annotations

import pytest
import torch
from tensordict.nn import TensorDictModule

from phihp_torchrl.evaluation import measure_latency

from .policies import constant, planner


@pytest.mark.parametrize("make", [constant, planner])
def test_latency_percentiles_are_ordered(make):
    latency = measure_latency(make(), "pendulum", calls=40, warmup=3)
    assert 0 < latency.p50 <= latency.p90 <= latency.p99 <= latency.p99_9
    assert latency.p50 < 1000
    assert (latency.calls, latency.threads) == (40, torch.get_num_threads())
    assert set(latency.summary()) == {
        f"latency_ms_{name}" for name in ("mean", "p50", "p90", "p99", "p99_9")
    }


def test_latency_calls_with_single_observations():
    seen = []
    policy = TensorDictModule(lambda o: seen.append(o) or o[..., :1], ["observation"], ["action"])
    measure_latency(policy, "acrobot", calls=5, warmup=2)
    assert [observation.shape for observation in seen] == [(6,)] * 7
    assert len({tuple(observation.tolist()) for observation in seen}) == 7


def test_latency_is_of_the_timed_calls_alone(monkeypatch):
    """A clock by hand: the two calls before are long, the timed ones take 1, 2, 3 and 4 ms."""
    now, durations = [0.0], iter([9.0, 9.0, 0.001, 0.002, 0.003, 0.004])

    def act(observation):
        now[0] += next(durations)
        return observation[..., :1]

    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    policy = TensorDictModule(act, ["observation"], ["action"])
    latency = measure_latency(policy, "pendulum", calls=4, warmup=2)
    assert latency.mean == pytest.approx(2.5)
    assert latency.p50 == pytest.approx(2.5)
    assert latency.p99_9 == pytest.approx(4.0, abs=0.01)


def test_only_the_first_call_starts_an_episode():
    starts = []
    policy = TensorDictModule(
        lambda o, start: starts.append(start.item()) or o[..., :1],
        ["observation", "is_init"],
        ["action"],
    )
    measure_latency(policy, "pendulum", calls=3, warmup=1)
    assert starts == [True, False, False, False]
