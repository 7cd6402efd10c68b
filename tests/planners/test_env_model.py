"""Planning on other people's environments, with their own keys, transforms and models."""

from __future__ import annotations

import logging

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import (
    ActionScaling,
    Compose,
    EnvBase,
    GymEnv,
    InitTracker,
    ObservationNorm,
    PendulumEnv,
    RewardScaling,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.model_based import ModelBasedEnvBase
from torchrl.modules import MLP, MPCPlannerBase, WorldModel

from phihp_torchrl import CEMPlanner

from .planner_parts import Concatenate, make_planner, noise_for, task_parts

# Nested keys.


class Clock(EnvBase):
    """Counts its steps. Where it stands and what it is told goes through nested keys."""

    batch_locked = False

    def __init__(self):
        super().__init__(device="cpu")
        self.observation_spec = Composite(robot=Composite(where=Unbounded(2)))
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Composite(
            robot=Composite(push=Bounded(torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 4.0])))
        )
        self.reward_spec = Composite(robot=Composite(pay=Unbounded(1)))
        self.done_spec = Composite(
            robot=Composite(
                done=Binary(1, dtype=torch.bool), terminated=Binary(1, dtype=torch.bool)
            )
        )

    def _reset(self, tensordict=None, **_):
        batch = torch.Size([]) if tensordict is None else tensordict.batch_size
        robot = {"where": torch.zeros(*batch, 2), "terminated": torch.zeros(*batch, 1, dtype=bool)}
        return TensorDict({"robot": robot}, batch_size=batch)

    def _step(self, tensordict):
        where = tensordict["robot", "where"] + 0.1 * tensordict["robot", "push"]
        over = (where.abs() > 1).any(-1, keepdim=True)
        pay = -(where - 0.5).square().sum(-1, keepdim=True)
        robot = {"where": where, "pay": pay, "terminated": over, "done": over.clone()}
        return TensorDict({"robot": robot}, batch_size=tensordict.batch_size)

    def _set_seed(self, seed):
        pass


CLOCK_KEYS = {
    "reward_key": ("next", "robot", "pay"),
    "action_key": ("robot", "push"),
}


def test_nested_keys():
    env = Clock()
    actor = TensorDictModule(nn.Linear(2, 2), [("robot", "where")], [("robot", "push")])
    qvalue = TensorDictModule(
        Concatenate(nn.Linear(4, 1)), [("robot", "where"), ("robot", "push")], [("robot", "q")]
    )
    torch.manual_seed(0)
    planner = make_planner(env, actor, qvalue, **CLOCK_KEYS, value_key=("robot", "q"))
    assert planner.in_keys == [("robot", "where")]
    assert planner.out_keys == [("robot", "push")]
    assert planner.done_keys == [("next", "robot", "terminated")]
    for batch in ((), (3,), (2, 3)):
        robot = {"where": torch.zeros(*batch, 2)}
        tensordict = planner(TensorDict({"robot": robot}, batch_size=batch))
        assert tensordict["robot", "push"].shape == (*batch, 2)
    planner = make_planner(env, **CLOCK_KEYS)
    assert env.rollout(20, planner)["next", "robot", "pay"][-1] > -0.05


# Other people's environments.


def test_it_swings_torchrls_own_pendulum():
    torch.manual_seed(0)
    env = PendulumEnv()
    planner = CEMPlanner(env, 15, 3, 64, 8)
    assert isinstance(planner, MPCPlannerBase)
    assert not planner.uses_tensors
    start = env.reset(env.gen_params(batch_size=[8]))
    rewards = {
        name: env.rollout(
            40, policy, auto_reset=False, tensordict=start.clone(), break_when_any_done=False
        )["next", "reward"].sum(1)
        for name, policy in {"planned": planner, "random": None}.items()
    }
    assert (rewards["planned"] > rewards["random"]).all()
    assert rewards["planned"].mean() > 0.7 * rewards["random"].mean()


class ImaginedEnv(ModelBasedEnvBase):
    """A stock WorldModel as an environment of any batch size, with the specs of ``base``.

    The stock WorldModelEnv asks for one fixed batch size, so no planner can use it, not even
    TorchRL's own.
    """

    def __init__(self, model, base, observation_spec):
        super().__init__(model.step_module, device="cpu", batch_size=torch.Size([]))
        self.observation_spec = observation_spec
        self.state_spec = observation_spec.clone()
        self.action_spec, self.reward_spec = base.action_spec, base.reward_spec

    def _step(self, tensordict):
        step = self.world_model(tensordict.copy())["next"]
        return step.set("done", torch.zeros_like(step["reward"], dtype=torch.bool))

    def _reset(self, tensordict=None, **_):
        raise NotImplementedError


def stock_model_env():
    """A stock WorldModel with MLPs, that imagines in the space of observations."""
    base = GymEnv("Pendulum-v1")
    inputs = ["observation", "action"]
    model = WorldModel(
        encoder=TensorDictModule(nn.Identity(), ["observation"], ["observation"]),
        dynamics=TensorDictModule(
            Concatenate(MLP(4, 3, num_cells=[16])), inputs, [("next", "observation")]
        ),
        reward_head=TensorDictModule(
            Concatenate(MLP(4, 1, num_cells=[16])), inputs, [("next", "reward")]
        ),
    )
    return base, ImaginedEnv(model, base, Composite(observation=Unbounded(3)))


@pytest.mark.parametrize("options", [{}, {"replan_every": 2, "warm_start": True}])
def test_a_stock_collector_plans_on_a_stock_world_model(options):
    torch.manual_seed(0)
    world, env = stock_model_env()
    actor = TensorDictModule(nn.Linear(3, 1), ["observation"], ["action"])
    qvalue = TensorDictModule(
        Concatenate(nn.Linear(4, 1)), ["observation", "action"], ["state_action_value"]
    )
    planner = make_planner(env, actor, qvalue, **options)
    collector = Collector(
        TransformedEnv(world, InitTracker()), planner, frames_per_batch=12, total_frames=24
    )
    batches = list(collector)
    collector.shutdown()
    assert sum(batch.numel() for batch in batches) == 24
    for batch in batches:
        assert (batch["action"].abs() <= 2).all()
        assert batch["action"].unique().numel() > 6


def test_an_encoder_before_the_planner():
    """A latent model: the encoder runs once, the planner imagines in its space."""
    torch.manual_seed(0)
    base = GymEnv("Pendulum-v1")
    encoder = TensorDictModule(nn.Linear(3, 5), ["observation"], ["latent"])
    model = WorldModel(
        encoder=encoder,
        dynamics=TensorDictModule(
            Concatenate(nn.Linear(6, 5)), ["latent", "action"], [("next", "latent")]
        ),
        reward_head=TensorDictModule(nn.Linear(5, 1), [("next", "latent")], [("next", "reward")]),
    )
    env = ImaginedEnv(model, base, Composite(latent=Unbounded(5)))
    policy = TensorDictSequential(encoder, make_planner(env))
    assert base.rollout(3, policy)["action"].shape == (3, 1)


@pytest.mark.parametrize("backend", ["auto", "env"])
def test_transforms_are_not_lost(backend, caplog):
    """Rewards are scaled; what only counts steps is left out, and needs no key in the plan."""
    _, env, _, _ = task_parts("pendulum")
    plain = make_planner(env)
    scaled = TransformedEnv(env, Compose(StepCounter(), RewardScaling(1e3, 2.0)))
    with caplog.at_level(logging.INFO, logger="phihp_torchrl"):
        planner = make_planner(scaled, backend=backend)
    assert planner.uses_tensors == (backend == "auto")
    assert len(caplog.records) == (backend == "env")
    start = env.reset() if backend == "auto" else scaled.reset()
    noise = noise_for(planner)
    bare, found = plain.plan(start, noise), planner.plan(start, noise)
    gamma, horizon = plain.settings.gamma, plain.settings.planning_horizon
    offset = 1e3 * sum(gamma**k for k in range(horizon))
    torch.testing.assert_close(found.score, 2.0 * bare.score + offset)


def test_other_transforms_are_stepped(caplog):
    _, env, _, _ = task_parts("pendulum")
    with caplog.at_level(logging.INFO, logger="phihp_torchrl"):
        planner = make_planner(TransformedEnv(env, ActionScaling()))
    assert not planner.uses_tensors
    assert [record.getMessage() for record in caplog.records] == [
        "CEMPlanner steps the environment: its ActionScaling may change more than the reward."
    ]
    assert planner.in_keys == ["observation"], "the state is computed where it is missing"
    action = planner(env.reset().select("observation"))["action"]
    assert action.abs() <= 1.0
    changed = TransformedEnv(env, ObservationNorm(0.0, 2.0, in_keys=["observation"]))
    assert make_planner(changed).in_keys == ["observation", "state"]
