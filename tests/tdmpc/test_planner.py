"""Planning among latents, with a horizon that grows and a floor that falls."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from lopsided import LOPSIDED
from points import Point, half_way
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import check_env_specs

from phihp_torchrl import MPPIPlanner
from phihp_torchrl.planners import MPPIConfig
from phihp_torchrl.tasks import ActionBounds
from phihp_torchrl.tdmpc import TOLD, LatentEnv, ScheduledMPPIConfig, make_latent_planner

from .told_parts import make_told

# The schedule.


def test_the_schedule_is_linear_and_can_be_assigned():
    config = ScheduledMPPIConfig(num_candidates=32, top_k=4, num_policy_candidates=0)
    assert [config.at(n).planning_horizon for n in (0, 6249, 6250, 24_999, 25_000, 10**6)] == [
        1, 1, 2, 4, 5, 5,
    ]  # fmt: skip
    assert [config.at(n).min_std for n in (0, 25_000, 10**6)] == [0.5, 0.05, 0.05]
    assert config.at(12_500).min_std == pytest.approx(0.275)
    assert type(config.at(0)) is MPPIConfig
    planner = make_latent_planner(make_told(), config.at(25_000))
    td = TensorDict(latent=torch.randn(2, 6), batch_size=[2])
    assert planner.plan(td).mean.shape == (2, 5, 1)
    planner.settings = config.at(12_500)
    assert planner.plan(td).mean.shape == (2, 3, 1)
    planner(td.clone())
    planner.settings = replace(config.at(25_000), optim_steps=1, top_k=2)
    assert planner(td.clone())["action"].shape == (2, 1)
    assert planner.plan(td).mean.shape == (2, 5, 1)


def test_a_schedule_of_no_steps_has_arrived():
    config = ScheduledMPPIConfig(schedule_steps=0)
    own = {f.name: getattr(config, f.name) for f in fields(MPPIConfig)}
    assert config.at(0) == MPPIConfig(**own)


@pytest.mark.parametrize(
    ("name", "value"), [("initial_horizon", 6), ("initial_min_std", 0.01), ("schedule_steps", -1)]
)
def test_schedules_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        ScheduledMPPIConfig(**{name: value})


# The latent environment.


def test_latent_env_keeps_its_contract():
    bounds = ActionBounds.from_limits([-1.0, -0.5], [1.0, 0.75])
    env = LatentEnv(Point(wall=2.0), 2, bounds, start=lambda shape: torch.zeros(*shape, 2))
    check_env_specs(env)
    actor = TensorDictModule(half_way, ["latent"], ["action"])
    settings = MPPIConfig(
        planning_horizon=4, num_candidates=60, top_k=8, num_policy_candidates=10, select="mean"
    )
    planners = [MPPIPlanner(env, settings, actor=actor, backend=b) for b in ("tensor", "env")]
    assert [planner.uses_tensors for planner in planners] == [True, False]
    td = TensorDict(latent=torch.full((3, 2), 0.8), batch_size=[3])
    noise = planners[0].draw_noise([3])
    torch.testing.assert_close(*(p.plan(td, noise).actions for p in planners))


def test_plans_among_latents_stay_in_lopsided_bounds():
    """From -6 to 12: neither symmetric nor met by noise of less than the half-range of 9."""
    settings = MPPIConfig(
        planning_horizon=3, optim_steps=2, num_candidates=32, top_k=4, num_policy_candidates=3
    )
    planner = make_latent_planner(make_told(bounds=LOPSIDED.bounds), settings)
    assert planner.uses_tensors
    assert planner.in_keys == ["latent", "is_init"]
    actions = planner.plan(TensorDict(latent=torch.randn(200, 6), batch_size=[200])).actions
    assert actions.shape == (200, 3, 1)
    assert actions.min().item() == -6.0
    assert actions.max().item() == 12.0


def test_a_latent_env_starts_from_the_latents_given():
    told = TOLD(3, ActionBounds.from_limits([-2.0], [2.0]))
    env = make_latent_planner(told, MPPIConfig(num_candidates=8, top_k=2)).env
    latent = torch.randn(3, told.config.latent_dim)
    given = TensorDict(latent=latent, batch_size=[3])
    assert torch.equal(env.reset(given)["latent"], latent)
    assert torch.equal(env.rollout(2, tensordict=given)["latent"][:, 0], latent)
    assert not env.reset(given, set_state=False)["latent"].any()
    old = env.step(env.rand_action(env.reset(given)))["next"].exclude("reward")
    mask = torch.tensor([[True], [False], [False]])
    fresh = env.reset(old.clone().set("_reset", mask))["latent"]
    assert not fresh[0].any()
    assert torch.equal(fresh[1:], old["latent"][1:])
