"""Returns, latency, pictures and tables, by hand and by property."""

from __future__ import annotations

import importlib.util
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.envs import GymEnv

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents.networks import Actor, TwinQ
from phihp_torchrl.deployment import Agent
from phihp_torchrl.envs import make_task_env
from phihp_torchrl.evaluation import (
    EVALUATION_SEED,
    TaskResult,
    check_training_seed,
    episode_figure,
    evaluate,
    evaluation_seed,
    markdown_table,
    mean_and_std,
    measure_latency,
    play_episode,
    returns_table,
    write_gif,
)
from phihp_torchrl.planners.factory import PlannerConfig
from phihp_torchrl.tasks import list_tasks


def constant(value=0.0, size=1):
    return TensorDictModule(
        lambda observation: torch.full_like(observation[..., :size], value),
        ["observation"],
        ["action"],
    )


def balance():
    """Keeps CartPole upright: push the cart to where the pole leans."""
    gains = torch.tensor([0.5, 1.0, 0.0, 30.0, 5.0])
    return TensorDictModule(
        lambda obs: (obs * gains).sum(-1, keepdim=True).clamp(-10, 10), ["observation"], ["action"]
    )


class Noisy(TensorDictModuleBase):
    """Draws from the global generator, and counts what it is told."""

    in_keys = ["observation"]
    out_keys = ["action"]

    def __init__(self):
        super().__init__()
        self.starts = []

    def forward(self, tensordict):
        self.starts.append(tensordict["is_init"].clone())
        return tensordict.set("action", torch.randn_like(tensordict["observation"][..., :1]))


def planner(name="pendulum", **options):
    task = get_task(name)
    config = PlannerConfig(
        planning_horizon=3, optim_steps=2, num_candidates=8, top_k=2, num_policy_candidates=2
    )
    return Agent(
        task,
        dynamics=HybridDynamics.oracle(task),
        actor=Actor(task, (8,)),
        qvalue=TwinQ(task, (8,)),
        planner_config=replace(config, **options),
    )


# Returns


def test_returns_by_hand():
    # Without a push the pole falls; every step counts 1, the last included.
    result = evaluate(constant(), "cartpole", episodes=20)
    assert torch.equal(result.returns, result.lengths.to(torch.float64))
    assert result.terminated.all()
    assert 5 < result.mean < 200
    result = evaluate(balance(), "cartpole", episodes=8)
    assert result.returns.tolist() == [500.0] * 8
    assert not result.terminated.any(), "running out of steps is not termination"
    assert (result.mean, result.std, result.standard_error) == (500.0, 0.0, 0.0)
    # One step of a pendulum, by its reward.
    task = replace(get_task("pendulum"), max_steps=1)
    state = task.reset.sample([6], generator=torch.Generator().manual_seed(3))
    expected = -(state[:, 0].square() + 0.1 * state[:, 1].square() + 0.001 * 1.5**2)
    result = evaluate(constant(1.5), task, episodes=6, seed=3)
    torch.testing.assert_close(result.returns, expected.to(torch.float64))


@pytest.mark.parametrize("name", list_tasks())
def test_the_fast_way_is_the_environments_way(name):
    task = replace(get_task(name), max_steps=60)
    policy = Actor(task, (8,))
    policy = TensorDictModule(policy, ["observation"], ["action"])
    fast = evaluate(policy, task, episodes=6, seed=5)
    slow = evaluate(policy, task, episodes=6, seed=5, env=make_task_env(task, [6]))
    torch.testing.assert_close(fast.returns, slow.returns, rtol=1e-4, atol=1e-4)
    assert torch.equal(fast.lengths, slow.lengths)
    assert torch.equal(fast.terminated, slow.terminated)


def test_rewards_after_the_end_do_not_count():
    task = replace(
        get_task("cartpole"),
        terminated=lambda state: state[..., 2].abs() > 0.01,
        reward=lambda state, action, next_state: state[..., 2].abs() * 1e3,
    )
    for env in (None, make_task_env(task, [20])):
        result = evaluate(constant(), task, episodes=20, env=env)
        assert result.terminated.all()
        assert (result.returns <= 1e3 * (0.01 * (result.lengths - 1) + 0.05)).all()


def test_seeds_reproduce_and_pair():
    agent = planner(warm_start=True)
    task = replace(agent.task, max_steps=15)
    first = evaluate(agent, task, episodes=4, seed=1)
    assert torch.equal(first.returns, evaluate(agent, task, episodes=4, seed=1).returns)
    assert not torch.equal(first.returns, evaluate(agent, task, episodes=4, seed=2).returns)
    # Without randomness in the policy the same starts mean the same returns, alone or in a batch.
    start = replace(task, max_steps=1)
    still = evaluate(constant(), start, episodes=4, seed=1).returns
    assert torch.equal(still, evaluate(constant(), start, episodes=7, seed=1).returns[:4])


def test_a_policy_without_noise_does_not_see_the_batch():
    task = replace(get_task("cartpole-swingup"), max_steps=40)
    policy = TensorDictModule(Actor(task, (8,)), ["observation"], ["action"])
    whole = evaluate(policy, task, episodes=6, seed=1)
    part = evaluate(policy, task, episodes=3, seed=1)
    torch.testing.assert_close(whole.returns[:3], part.returns)


def test_the_global_random_state_is_left_alone():
    task = replace(get_task("pendulum"), max_steps=3)
    before = torch.get_rng_state()
    evaluate(Noisy(), task, episodes=2)
    evaluate(Noisy(), task, episodes=2, env=make_task_env(task, [2], seed=0))
    measure_latency(Noisy(), task, calls=2, warmup=0)
    play_episode(Noisy(), task)
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize("batch", [[], [2], [5]])
def test_other_environments_play_rounds(batch):
    task = replace(get_task("cartpole"), max_steps=30)
    policy = Noisy()
    result = evaluate(policy, task, episodes=5, seed=0, env=make_task_env(task, batch))
    assert result.returns.shape == result.lengths.shape == (5,)
    assert policy.starts[0].all()
    assert not policy.starts[1].any()
    if batch == []:
        assert sum(int(start) for start in policy.starts) == 5
    assert torch.equal(result.returns, result.lengths.to(torch.float64))


def test_gymnasium_worlds_play_too():
    env = GymEnv("phihp/CartPole-v0")
    result = evaluate(constant(), "cartpole", episodes=2, env=env)
    assert result.terminated.all()
    assert torch.equal(result.returns, result.lengths.to(torch.float64))


def test_summary_is_numbers():
    summary = evaluate(constant(), "cartpole", episodes=3).summary()
    assert all(isinstance(value, float) and math.isfinite(value) for value in summary.values())
    assert summary["return_min"] <= summary["return_mean"] <= summary["return_max"]
    assert evaluate(constant(), "cartpole", episodes=1).std == 0.0


def test_bad_arguments_are_named():
    for episodes in (0, -1, 1.5, True):
        with pytest.raises(ValueError, match="episodes: expected a positive whole number"):
            evaluate(constant(), "cartpole", episodes=episodes)
    with pytest.raises(ValueError, match="task: expected one of"):
        evaluate(constant(), "no-such-task")
    with pytest.raises(ValueError, match="env: expected batch size"):
        evaluate(constant(), "cartpole", env=make_task_env("cartpole", [2, 2]))
    with pytest.raises(ValueError, match="calls: expected"):
        measure_latency(constant(), "cartpole", calls=0)
    with pytest.raises(ValueError, match="warmup: expected"):
        measure_latency(constant(), "cartpole", warmup=-1)
    with pytest.raises(ValueError, match="max_steps: expected"):
        play_episode(constant(), "cartpole", max_steps=0)
    with pytest.raises(ValueError, match="frames_per_second: expected"):
        play_episode(constant(), "cartpole", frames_per_second=0)


# Seeds


def test_evaluation_and_training_share_no_seed():
    assert evaluation_seed() == EVALUATION_SEED == 1_000_000
    assert evaluation_seed(7) == 1_000_007
    assert check_training_seed(999_999) == 999_999
    for seed in (-1, EVALUATION_SEED, evaluation_seed(3)):
        with pytest.raises(ValueError, match="seed: expected 0 to 999999"):
            check_training_seed(seed)
    with pytest.raises(ValueError, match="k: expected"):
        evaluation_seed(-1)


# Latency


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


# Episodes and their pictures


def test_an_episode_is_what_was_evaluated():
    task = replace(get_task("cartpole"), env_id=None)
    episode = play_episode(balance(), task, max_steps=50)
    assert episode.states.shape == (51, 4)
    assert episode.actions.shape == (50, 1)
    assert episode.total_reward == 50.0
    assert not episode.terminated
    assert episode.frames.size == 0
    states = torch.from_numpy(episode.states)
    expected = task.step(states[:-1], torch.from_numpy(episode.actions))
    torch.testing.assert_close(states[1:], expected)
    fallen = play_episode(constant(), task)
    assert fallen.terminated
    assert len(fallen.rewards) < 200
    again = play_episode(balance(), task, max_steps=50)
    assert np.array_equal(again.states, episode.states)
    other = play_episode(balance(), task, max_steps=50, seed=evaluation_seed(1))
    assert not np.array_equal(other.states, episode.states)


@pytest.fixture(scope="module")
def rendered():
    pytest.importorskip("pygame")
    return play_episode(constant(2.0), "pendulum-swingup", max_steps=30, render=True)


def test_gif(rendered, tmp_path):
    assert rendered.frames.shape[0] == 31
    path = write_gif(rendered, tmp_path / "new" / "episode.gif", size=96)
    assert path.stat().st_size < 1_000_000
    assert [p.name for p in path.parent.iterdir()] == ["episode.gif"]
    with Image.open(path) as image:
        assert image.format == "GIF"
        assert image.size == (96, 96)
        assert image.n_frames > 10
        assert image.info["duration"] == 50
        pictures = []
        for i in (0, image.n_frames - 1):
            image.seek(i)
            pictures.append(np.asarray(image.convert("RGB"), dtype=float))
    assert all(picture.std() > 5 for picture in pictures), "blank"
    assert np.abs(pictures[0] - pictures[1]).max() > 50, "nothing moves"


def test_gif_keeps_within_its_size(rendered, tmp_path):
    large = write_gif(rendered, tmp_path / "large.gif").stat().st_size
    small = write_gif(rendered, tmp_path / "small.gif", max_bytes=large // 3).stat().st_size
    assert small <= large // 3
    with pytest.raises(ValueError, match="max_bytes: expected at least"):
        write_gif(rendered, tmp_path / "no.gif", max_bytes=10)
    with pytest.raises(ValueError, match="size: expected"):
        write_gif(rendered, tmp_path / "no.gif", size=1)
    with pytest.raises(ValueError, match="episode: expected pictures"):
        write_gif(play_episode(constant(), "pendulum", max_steps=2), tmp_path / "no.gif")
    assert not (tmp_path / "no.gif").exists()


def test_frames_are_subsampled_and_limited():
    pytest.importorskip("pygame")
    options = {"max_steps": 25, "render": True}
    episode = play_episode(constant(), "cartpole-swingup", frames_per_second=10, **options)
    assert episode.frame_steps == 5
    assert len(episode.frames) == 6
    assert len(play_episode(constant(), "acrobot", max_frames=3, **options).frames) == 3


def test_pictures_without_pygame(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pygame: .*phihp_torchrl\[rendering\]"):
        play_episode(constant(), "pendulum", render=True)
    assert len(play_episode(constant(), "pendulum", max_steps=2).rewards) == 2


@pytest.mark.parametrize("name", ["pendulum", "acrobot-swingup"])
def test_episode_figure(name, tmp_path):
    task = get_task(name)
    episode = play_episode(constant(1.0, task.system.action_dim), task, max_steps=40)
    figure = episode_figure(episode)
    assert len(figure.axes) == task.system.state_dim + task.system.action_dim + 1
    labels = [axis.get_ylabel() for axis in figure.axes]
    assert labels == [*task.system.state_names, *task.system.action_names, "reward"]
    velocity = labels.index(task.system.state_names[-1])
    drawn = figure.axes[velocity].lines[0].get_ydata()
    np.testing.assert_array_equal(drawn, episode.states[:, -1])
    angle = figure.axes[0].lines[0].get_ydata()
    assert np.nanmax(np.abs(angle)) <= math.pi
    figure.savefig(tmp_path / "episode.png")
    assert np.asarray(Image.open(tmp_path / "episode.png").convert("L")).std() > 5


# Tables


def test_tables():
    text = markdown_table(["a", "b"], [["x|y", "1"], ["z", "2"]])
    assert text == "| a | b |\n|:---|---:|\n| x\\|y | 1 |\n| z | 2 |\n"
    with pytest.raises(ValueError, match="rows: expected 2 cells, got 1"):
        markdown_table(["a", "b"], [["x"]])
    text = returns_table(
        [
            TaskResult("cartpole", 5000, planner=(500.0, 500.0, 497.0), actor=(480.0,)),
            TaskResult("cartpole-swingup", 500, actor=(400.0, 410.0)),
        ]
    )
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()[2:]]
    assert rows == [
        ["cartpole", "3", "5000", "499.0 ± 1.7", "480.0", "500", "500 ± 0", "5000"],
        ["cartpole-swingup", "2", "500", "–", "405.0 ± 7.1", "420", "–", "–"],
    ]
    assert mean_and_std([-1.25, -1.75], 2) == "−1.50 ± 0.35"
