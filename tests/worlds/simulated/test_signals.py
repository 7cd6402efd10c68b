"""Simulated worlds give references and inputs: by seed, by options, and shown with a preview."""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict.nn import TensorDictModule

from phihp_torchrl.evaluation import evaluate
from phihp_torchrl.tasks import Actuator
from phihp_torchrl.worlds import SimulatedWorld, TaskEnv
from tests.followed import AIM, Mass, disturbed, followed

TASK = followed(Mass(), reference=replace(AIM, preview=2))


def test_it_passes_the_check_of_gymnasium():
    check_env(TaskEnv(TASK), skip_render_check=True)


def test_a_seed_draws_the_same_signals_and_another_seed_others():
    env = TaskEnv(TASK)

    def shown(seed):
        first, _ = env.reset(seed=seed)
        return np.stack([first, *(env.step(np.zeros(1))[0] for _ in range(10))])

    assert (shown(0) == shown(0)).all()
    assert (shown(0)[:, 2:] != shown(1)[:, 2:]).any()


def test_options_give_a_value_that_stays():
    env = TaskEnv(TASK)
    observation, info = env.reset(options={"reference": [0.5], "inputs": [1.0]})
    for _ in range(3):
        assert observation[2:].tolist() == [0.5, 0.5, 0.5, 0.5]  # the wind is shown in half-ranges
        assert (info["reference"].tolist(), info["inputs"].tolist()) == ([0.5], [1.0])
        observation, _, _, _, info = env.step(np.zeros(1))


def test_options_give_a_trajectory_whose_last_value_stays():
    env = TaskEnv(TASK)
    ramp = np.array([[0.0], [0.25], [0.5], [0.75]])
    observation, _ = env.reset(options={"reference": ramp})
    rows = [observation[3:].tolist()]
    for _ in range(4):
        rows.append(env.step(np.zeros(1))[0][3:].tolist())
    assert rows == [
        [0.0, 0.25, 0.5],
        [0.25, 0.5, 0.75],
        [0.5, 0.75, 0.75],
        [0.75, 0.75, 0.75],
        [0.75, 0.75, 0.75],
    ]


def test_the_reward_follows_the_reference_and_inputs_push():
    env = TaskEnv(TASK)
    env.reset(options={"state": [0.0, 0.0], "reference": [0.5], "inputs": [2.0]})
    _, reward, *_ = env.step(np.zeros(1))
    assert env.state[1] == pytest.approx(0.1 * 2.0)
    assert reward == pytest.approx(-((env.state[0] - 0.5) ** 2))
    assert env.last_action.tolist() == [0.0]


@pytest.mark.parametrize("given", [[0.5, 0.5], [[0.5, 0.5]], [np.nan], np.zeros((0, 1))])
def test_a_wrong_reference_is_refused_by_its_key(given):
    with pytest.raises(ValueError, match=r"^options\.reference: expected finite values of shape"):
        TaskEnv(TASK).reset(options={"reference": given})


def test_an_unknown_option_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match=r"expected at most \['inputs', 'reference', 'state'\]"):
        TaskEnv(TASK).reset(options={"goal": [0.5]})


def test_the_torchrl_environment_shows_signals_and_what_is_under_way():
    task = replace(TASK, actuator=Actuator(delay_steps=1.0))
    rollout = SimulatedWorld(task).make_env().rollout(15)
    state = task.locate(rollout["next", "observation"])
    assert rollout["observation"].shape == (15, task.observation_dim)
    assert torch.allclose(state[:, -1], rollout["action"][:, 0], atol=1e-5)
    reference = state[:, 3:6]
    assert torch.allclose(reference[:-1, 1:], reference[1:, :2])


def test_an_episode_in_the_environment_has_the_return_of_the_task():
    env = gym.make("phihp/Task-v0", task=TASK)
    env.reset(seed=3)
    total, over = 0.0, False
    while not over:
        _, reward, ended, cut, info = env.step(np.zeros(1, dtype=np.float32))
        total, over = total + reward, ended or cut
    assert total < 0.0
    assert info["reference"].shape == (1,)


def test_evaluation_draws_references_by_its_seed():
    task = disturbed()
    chase = TensorDictModule(
        lambda o: 4.0 * (o[..., 2:3] - o[..., :1]) - 3.0 * o[..., 1:2], ["observation"], ["action"]
    )
    still = TensorDictModule(lambda o: 0.0 * o[..., :1], ["observation"], ["action"])
    returns = {
        name: evaluate(policy, task, episodes=20, seed=7).returns
        for name, policy in {"chase": chase, "still": still, "again": still}.items()
    }
    assert returns["still"].equal(returns["again"])
    assert returns["chase"].mean() > returns["still"].mean()
    other = evaluate(still, task, episodes=20, seed=8).returns
    assert not other.equal(returns["still"])
