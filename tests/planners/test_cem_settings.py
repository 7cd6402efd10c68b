"""What a CEMPlanner and its CEMConfig are told, and what they refuse, by name."""

from __future__ import annotations

from math import inf, nan

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import GymEnv, PendulumEnv
from torchrl.envs.model_based import WorldModelEnv as StockWorldModelEnv

from phihp_torchrl import CEMPlanner, WorldModelEnv
from phihp_torchrl.planners import CEMConfig

from .planner_parts import make_planner, task_parts

# Candidates of the actor.


def build(env, actor=None, num_candidates=32, **settings):
    return CEMPlanner(env, 4, 2, num_candidates, 5, actor=actor, **settings)


def test_without_an_actor_no_candidates_come_from_it():
    _, env, _, _ = task_parts("pendulum")
    assert build(env).settings.num_policy_candidates == 0
    assert build(env, num_policy_candidates=0).settings.num_policy_candidates == 0


@pytest.mark.parametrize(("candidates", "expected"), [(5, 5), (19, 19), (20, 20), (32, 20)])
def test_with_an_actor_twenty_do_or_all_there_are(candidates, expected):
    _, env, actor, _ = task_parts("pendulum")
    planner = build(env, actor, candidates)
    assert planner.settings.num_policy_candidates == expected
    few = build(env, actor, candidates, num_policy_candidates=3)
    assert few.settings.num_policy_candidates == 3
    assert build(env, actor, num_policy_candidates=0).settings.num_policy_candidates == 0


def test_a_number_without_an_actor_is_refused_by_name():
    _, env, _, _ = task_parts("pendulum")
    with pytest.raises(
        ValueError, match=r"^actor: expected a module to propose num_policy_candidates=3 sequences"
    ):
        build(env, num_policy_candidates=3)
    with pytest.raises(ValueError, match=r"^actor: .* num_policy_candidates=20 sequences"):
        CEMPlanner.from_config(env, CEMConfig())


def test_other_defaults_are_those_of_the_settings():
    _, env, actor, _ = task_parts("pendulum")
    settings = build(env, actor).settings
    assert settings == CEMConfig(
        planning_horizon=4, optim_steps=2, num_candidates=32, top_k=5, num_policy_candidates=20
    )
    assert (settings.init_std, settings.policy_noise, settings.policy_noise_clip) == (1.0, 0.2, 0.6)


def test_a_planner_of_settings_has_them_all():
    _, env, actor, qvalue = task_parts("pendulum")
    config = CEMConfig(
        planning_horizon=3,
        optim_steps=1,
        num_candidates=9,
        top_k=4,
        num_policy_candidates=2,
        policy_noise=0.3,
        policy_noise_clip=0.4,
        alpha=0.5,
        gamma=0.8,
        init_std=0.7,
        min_std=0.1,
        tail_dtype="bfloat16",
        num_kept_elites=1,
        select="best",
        compare_with_actor=False,
        actor_margin=0.2,
        replan_every=2,
        warm_start=True,
    )
    planner = CEMPlanner.from_config(env, config, actor=actor, qvalue=qvalue)
    assert planner.settings == config
    assert (planner.receding.replan_every, planner.receding.warm_start) == (2, True)


# Bad arguments.


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (
            {"planning_horizon": 0},
            r"planning_horizon: expected a whole number >= 1 "
            r"of steps, or seconds such as '1\.5 s', got 0",
        ),
        (
            {"planning_horizon": 2.0},
            r"planning_horizon: expected a whole number >= 1 "
            r"of steps, or seconds such as '1\.5 s', got 2\.0",
        ),
        ({"optim_steps": 0}, r"optim_steps: expected a whole number >= 1, got 0"),
        ({"num_candidates": -1}, r"num_candidates: expected a whole number >= 1, got -1"),
        ({"top_k": 0}, r"top_k: expected a whole number >= 1, got 0"),
        ({"top_k": 33}, r"top_k: expected at most num_candidates = 32, got 33"),
        (
            {"num_policy_candidates": 33},
            r"num_policy_candidates: expected at most num_candidates = 32, got 33",
        ),
        (
            {"num_policy_candidates": -1},
            r"num_policy_candidates: expected a whole number >= 0, got -1",
        ),
        ({"num_kept_elites": 6}, r"num_kept_elites: expected at most top_k = 5, got 6"),
        ({"policy_noise": -0.1}, r"policy_noise: expected a number >= 0, got -0\.1"),
        ({"policy_noise_clip": nan}, r"policy_noise_clip: expected a finite number, got nan"),
        ({"init_std": 0.0}, r"init_std: expected a positive number, got 0\.0"),
        ({"min_std": inf}, r"min_std: expected a finite number, got inf"),
        ({"alpha": -1.0}, r"alpha: expected a number >= 0, got -1\.0"),
        ({"actor_margin": -1.0}, r"actor_margin: expected a number >= 0, got -1\.0"),
        (
            {"gamma": 1.5},
            r"gamma: expected a number in \[0, 1\], "
            r"or a time constant such as '5 s', got 1\.5",
        ),
        ({"select": "median"}, r"select: expected one of \['mean', 'best'\], got 'median'"),
        ({"tail_dtype": "float16"}, r"tail_dtype: expected one of \['float32', 'bfloat16'\]"),
        (
            {"replan_every": 0},
            r"replan_every: expected a whole number >= 1 "
            r"of steps, or seconds such as '1\.5 s', got 0",
        ),
        ({"replan_every": 5}, r"replan_every: expected at most planning_horizon = 4, got 5"),
        (
            {"replan_every": 1.5},
            r"replan_every: expected a whole number >= 1 "
            r"of steps, or seconds such as '1\.5 s', got 1\.5",
        ),
        ({"compare_with_actor": 1}, r"compare_with_actor: expected true or false, got 1"),
        ({"warm_start": 1}, r"warm_start: expected true or false, got 1"),
        ({"num_policy_candidates": 32, "warm_start": True}, r"warm_start: expected random"),
    ],
)
def test_settings_out_of_range_are_named(kwargs, message):
    sizes = {"planning_horizon": 4, "optim_steps": 2, "num_candidates": 32, "top_k": 5}
    with pytest.raises(ValueError, match=f"^{message}"):
        CEMConfig(**{**sizes, **kwargs})
    _, env, actor, qvalue = task_parts("pendulum")
    with pytest.raises(ValueError, match=f"^{message}"):
        make_planner(env, actor, qvalue, **kwargs)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"action_key": "torque"}, r"action_key: .* \['action'\], got 'torque'"),
        ({"reward_key": ("next", "pay")}, "reward_key: expected one of"),
        ({"reward_key": "reward"}, "reward_key"),
        ({"observation_key": "obs"}, r"observation_key: expected one of .* got 'obs'"),
        ({"done_keys": [("next", "finished")]}, "done_keys: expected some of"),
        ({"value_key": "q"}, "qvalue: expected a TensorDict module that writes 'q'"),
        ({"backend": "jax"}, "backend: expected 'auto', 'tensor' or 'env', got 'jax'"),
    ],
)
def test_keys_and_backends_that_there_are_not(kwargs, message):
    _, env, actor, qvalue = task_parts("pendulum")
    with pytest.raises(ValueError, match=f"^{message}"):
        make_planner(env, actor, qvalue, **kwargs)


@pytest.mark.parametrize("name", ["horizon", "num_candidate", "policy_noise_std", "memory"])
def test_unknown_settings_are_refused_by_name(name):
    _, env, actor, _ = task_parts("pendulum")
    with pytest.raises(TypeError, match=f"'{name}'"):
        make_planner(env, actor, **{name: 1})
    with pytest.raises(TypeError, match=f"'{name}'"):
        CEMConfig(**{name: 1})


def test_modules_that_are_missing_or_do_not_fit():
    _, env, _, qvalue = task_parts("pendulum")
    with pytest.raises(ValueError, match="actor: expected a module to propose"):
        make_planner(env, num_policy_candidates=3)
    with pytest.raises(ValueError, match="actor: expected a module to act beyond the horizon"):
        make_planner(env, None, qvalue)
    with pytest.raises(
        ValueError, match="actor: expected a TensorDict module that writes 'action'"
    ):
        make_planner(env, nn.Linear(3, 1))
    with pytest.raises(
        ValueError, match="actor: expected a TensorDict module that writes 'action'"
    ):
        make_planner(env, TensorDictModule(nn.Linear(3, 1), ["observation"], ["torque"]))
    with pytest.raises(ValueError, match="got 'tensor', but PendulumEnv has no tensor_model"):
        make_planner(PendulumEnv(), backend="tensor")
    latent = TensorDictModule(nn.Linear(2, 1), ["state"], ["action"])
    with pytest.raises(ValueError, match=r"got 'tensor', but actor or qvalue read \['state'\]"):
        make_planner(env, latent, backend="tensor")
    unseen = TensorDictModule(nn.Linear(2, 1), ["pixels"], ["action"])
    with pytest.raises(ValueError, match=r"actor: expected in_keys among .*, got \['pixels'\]"):
        make_planner(env, unseen)


def test_environments_that_cannot_be_planned_on():
    _, env, _, _ = task_parts("pendulum")
    with pytest.raises(ValueError, match="batch_locked"):
        make_planner(WorldModelEnv(env.tensor_model, batch_size=[4]))
    discrete = GymEnv("CartPole-v1")
    with pytest.raises(ValueError, match="env: expected continuous actions"):
        make_planner(discrete)
    stock = StockWorldModelEnv(env.tensor_model, GymEnv("Pendulum-v1"), batch_size=[1])
    with pytest.raises(ValueError, match=r"env: expected batch size \[\], got \[1\]"):
        make_planner(stock)


# Bad input.


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (torch.zeros(4), r"observation: expected torch.float32 of shape \[3\] on cpu, got .*\[4\]"),
        (torch.zeros(2, 3), r"of shape \[3\]"),
        (torch.zeros(3, dtype=torch.float64), "got torch.float64"),
        (torch.zeros(3, dtype=torch.long), "got torch.int64"),
        (torch.tensor([1.0, 0.0, nan]), "observation: expected finite observations"),
        (torch.tensor([1.0, 0.0, inf]), "observation: expected finite observations"),
        (None, r"observation: expected a tensor of shape \[3\], got none"),
    ],
)
@pytest.mark.parametrize("backend", ["tensor", "env"])
def test_bad_observations(observation, message, backend):
    _, env, actor, qvalue = task_parts("pendulum")
    planner = make_planner(env, actor, qvalue, backend=backend)
    tensordict = TensorDict(batch_size=[])
    if observation is not None:
        tensordict["observation"] = observation
    with pytest.raises(ValueError, match=message):
        planner(tensordict)


def test_bad_noise():
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env)
    tensordict = TensorDict(observation=torch.tensor([1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"noise: expected shape \[2, 4, 32, 1\], got \[1\]"):
        planner.planning(tensordict, torch.zeros(1))
