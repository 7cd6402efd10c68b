"""The planner, by property and by contract."""

from __future__ import annotations

import copy
import logging
from dataclasses import replace
from math import inf, nan

import pytest
import torch
from points import ZEROS, Point, bounds, half_way, point_problem
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, InitTracker, PendulumEnv, RewardScaling, TransformedEnv
from torchrl.envs.model_based import ModelBasedEnvBase
from torchrl.envs.model_based import WorldModelEnv as StockWorldModelEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, AdditiveGaussianModule, MPCPlannerBase, TanhModule, WorldModel

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import TwinQ
from phihp_torchrl.dynamics import TaskWorldModel
from phihp_torchrl.envs.world_model import WorldModelEnv
from phihp_torchrl.planners import (
    ActionBounds,
    CEMPlanner,
    PlanSettings,
    Problem,
    plan,
    pool,
    score_sequences,
)

torch.set_num_threads(1)
TASKS = ["pendulum-swingup", "cartpole", "acrobot", "acrobot-swingup"]


def settings(**kwargs):
    defaults = {"planning_horizon": 4, "optim_steps": 3, "num_candidates": 40, "top_k": 6}
    return PlanSettings(**{**defaults, **kwargs})


def draw(settings, batch=(), seed=0, action_dim=2):
    generator = torch.Generator().manual_seed(seed)
    shape = settings.noise_shape(batch, action_dim)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def flat_value(observation, action):
    return -observation.square().sum(-1) - action.square().sum(-1)


VARIANTS = [
    {},
    {"num_policy_candidates": 10},
    {"num_policy_candidates": 10, "num_kept_elites": 3, "select": "best"},
    {"num_policy_candidates": 40, "optim_steps": 1, "policy_noise": 0.2, "min_std": 0.1},
    {"num_policy_candidates": 1, "compare_with_actor": False, "num_kept_elites": 6},
]


# What a sequence is worth.


def test_score_by_hand():
    """Rewards are -1, -4 and Q is 10: -1 - 0.5 * 4 + 2 * 0.25 * 10."""
    problem = Problem(
        model=Point(goal=0.0),
        bounds=bounds((-9.0,), (9.0,)),
        actor=lambda observation: observation + 1,
        value=lambda observation, action: (observation + 4 * action - 4).squeeze(-1),
    )
    state = torch.zeros(1, 1, dtype=torch.float64)
    actions = torch.ones(2, 1, 1, dtype=torch.float64)
    scores, taken = score_sequences(state, actions, problem, gamma=0.5, alpha=2.0)
    assert scores.tolist() == [-1 - 0.5 * 4 + 2 * 0.25 * 10]
    assert taken is actions
    scores, _ = score_sequences(state, actions, problem, gamma=0.5, alpha=0.0)
    assert scores.tolist() == [-3.0]


def test_nothing_counts_after_a_termination():
    """The second and third of these leave the walls, at the first and at the last step."""
    problem = Problem(
        model=Point(goal=0.0, wall=1.5),
        bounds=bounds((-9.0,), (9.0,)),
        actor=lambda observation: observation,
        value=lambda observation, action: torch.full_like(observation[:, 0], 100.0),
    )
    actions = torch.tensor([[1.0, 2.0, 1.0], [-1.0, -2.0, 1.0]], dtype=torch.float64)
    state = torch.zeros(3, 1, dtype=torch.float64)
    scores, _ = score_sequences(state, actions.unsqueeze(-1), problem, gamma=0.5, alpha=1.0)
    assert scores.tolist() == [-1.0 + 25.0, -4.0, -1.0 - 0.5 * 4.0]


def test_what_is_not_finite_after_a_termination_does_not_count():
    def reward(state, action, reward):
        return torch.where(state[..., 0] > 1.5, nan, reward)

    problem = Problem(model=Point(goal=0.0, wall=1.5, reward=reward), bounds=bounds((-9,), (9,)))
    actions = torch.full((3, 1, 1), 2.0, dtype=torch.float64)
    state = torch.zeros(1, 1, dtype=torch.float64)
    scores, _ = score_sequences(state, actions, problem, gamma=1.0, alpha=1.0)
    assert scores.tolist() == [-4.0]


def test_the_actors_own_sequence_is_a_candidate(monkeypatch):
    seen = spy_on_scores(monkeypatch)
    s = settings(num_policy_candidates=5)
    plan(ZEROS, draw(s), problem=point_problem(half_way), settings=s)
    actions = seen[0][0][:, :5]  # [H, N_pi, m]
    state = ZEROS
    for action in actions[:, 0]:
        torch.testing.assert_close(action, half_way(state))
        state = state + action
    noise = (0.05 * draw(s)[0, 0, 1:5]).clamp(-0.3, 0.3) * bounds().scale
    torch.testing.assert_close(actions[0, 1:], half_way(ZEROS) + noise)


def test_policy_noise_is_clipped_in_units_of_the_half_range(monkeypatch):
    seen = spy_on_scores(monkeypatch)
    s = settings(num_policy_candidates=40, policy_noise=10.0, policy_noise_clip=0.1, optim_steps=1)
    plan(ZEROS, draw(s), problem=point_problem(torch.zeros_like), settings=s)
    largest = seen[0][0].abs().amax((0, 1))
    torch.testing.assert_close(largest, 0.1 * bounds().scale)


def spy_on_scores(monkeypatch):
    """A list that fills with the (actions, scores) of each scoring."""
    seen = []

    def spy(*args, **kwargs):
        scores, actions = score_sequences(*args, **kwargs)
        seen.append((actions, scores))
        return scores, actions

    monkeypatch.setattr(pool, "score_sequences", spy)
    return seen


# Properties of plans.


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("seed", range(3))
def test_plans_stay_in_bounds(variant, seed):
    s = settings(**variant)
    problem = point_problem(lambda observation: 10 * torch.ones_like(observation), goal=5.0)
    actions = plan(ZEROS, 3 * draw(s, seed=seed), problem=problem, settings=s).actions
    assert actions.shape == (4, 2)
    assert (actions >= problem.bounds.low).all()
    assert (actions <= problem.bounds.high).all()


def test_more_budget_is_no_worse_on_a_quadratic():
    observation = torch.linspace(-2, 2, 64, dtype=torch.float64).reshape(32, 2)
    problem = point_problem()

    def value_of(**kwargs):
        s = settings(**kwargs)
        actions = plan(observation, draw(s, (32,)), problem=problem, settings=s).actions
        scores, _ = score_sequences(
            observation, actions.transpose(0, 1), problem, gamma=s.gamma, alpha=s.alpha
        )
        return scores.mean().item()

    by_iterations = [value_of(optim_steps=i) for i in (1, 2, 4, 8)]
    assert by_iterations == sorted(by_iterations)
    by_candidates = [value_of(num_candidates=n) for n in (10, 40, 160, 640)]
    assert by_candidates == sorted(by_candidates)


@pytest.mark.parametrize("variant", VARIANTS)
def test_further_iterations_never_lose_the_best(variant):
    s = settings(**{**variant, "select": "best", "optim_steps": 6})
    noise, problem = draw(s), point_problem(half_way, flat_value)
    scores = [
        plan(ZEROS, noise[:i], problem=problem, settings=replace(s, optim_steps=i)).score.item()
        for i in range(1, 7)
    ]
    assert scores == sorted(scores)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("seed", range(3))
def test_never_beaten_by_its_own_candidates(variant, seed, monkeypatch):
    seen = spy_on_scores(monkeypatch)
    s = settings(**{**variant, "select": "best"})
    problem = point_problem(half_way, flat_value)
    found = plan(ZEROS, draw(s, seed=seed), problem=problem, settings=s)
    assert found.score == max(scores.max() for _, scores in seen)
    scores, _ = score_sequences(
        ZEROS[None], found.actions[:, None], problem, gamma=s.gamma, alpha=s.alpha
    )
    torch.testing.assert_close(scores[0], found.score)


@pytest.mark.parametrize("select", ["mean", "best"])
def test_never_beaten_by_its_own_actor(select, monkeypatch):
    """An actor that is hard to beat, with a budget that hardly suffices."""
    seen = spy_on_scores(monkeypatch)
    s = settings(num_policy_candidates=1, num_candidates=8, top_k=4, optim_steps=1, select=select)
    wins = 0
    for seed in range(20):
        del seen[:]
        found = plan(ZEROS, draw(s, seed=seed), problem=point_problem(half_way), settings=s)
        own_actions, own_score = seen[0][0][:, 0], seen[0][1][0]
        assert found.score >= own_score
        wins += int(torch.equal(found.actions, own_actions))
    assert wins > 0  # else this test is too easy


def test_a_margin_keeps_the_actor():
    problem = point_problem(torch.zeros_like)
    s = settings(num_policy_candidates=4)
    moved = plan(ZEROS, draw(s), problem=problem, settings=s).actions
    kept = plan(ZEROS, draw(s), problem=problem, settings=replace(s, actor_margin=1e3)).actions
    assert moved.abs().max() > 0.1
    assert torch.equal(kept, torch.zeros_like(kept))


@pytest.mark.parametrize("variant", VARIANTS)
def test_splitting_a_batch_changes_nothing(variant):
    s = settings(**variant)
    problem = point_problem(half_way, flat_value, wall=1.4)
    observation = torch.randn(2, 3, 2, dtype=torch.float64)
    noise = draw(s, (2, 3))
    whole = plan(observation, noise, problem=problem, settings=s)
    assert whole.actions.shape == (2, 3, 4, 2)
    assert whole.score.shape == (2, 3)
    for i in range(2):
        row = plan(observation[i], noise[:, :, :, i], problem=problem, settings=s)
        torch.testing.assert_close(row.actions, whole.actions[i])
        for j in range(3):
            single = plan(observation[i, j], noise[:, :, :, i, j], problem=problem, settings=s)
            torch.testing.assert_close(single.actions, whole.actions[i, j])
            torch.testing.assert_close(single.score, whole.score[i, j])


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("variant", VARIANTS)
def test_scores_that_are_not_finite_never_win(bad, variant):
    def reward(state, action, reward):  # the best actions by far, were they allowed
        return torch.where(action[..., 0] > 0, bad, reward)

    problem = point_problem(lambda observation: -half_way(observation), goal=3.0, reward=reward)
    s = settings(**{**variant, "select": "best"})
    found = plan(ZEROS, draw(s), problem=problem, settings=s)
    assert found.score.isfinite()
    assert (found.actions[:, 0] <= 0).all()
    assert plan(ZEROS, draw(s), problem=problem, settings=replace(s, select="mean")).score > -inf


def bad_problem(actor):
    return point_problem(actor, reward=lambda state, action, reward: reward * nan)


@pytest.mark.parametrize("select", ["mean", "best"])
@pytest.mark.parametrize("compare", [True, False])
@pytest.mark.parametrize("candidates", [0, 1, 10])
def test_an_all_bad_population_leaves_it_to_the_actor(select, compare, candidates):
    s = settings(num_policy_candidates=candidates, select=select, compare_with_actor=compare)
    found = plan(ZEROS, draw(s), problem=bad_problem(half_way), settings=s)
    torch.testing.assert_close(found.actions[0], half_way(ZEROS))
    assert found.score == -inf
    assert found.actions.isfinite().all()


def test_an_all_bad_population_without_actor_leaves_it_to_the_mean():
    s = settings()
    found = plan(ZEROS, draw(s), problem=bad_problem(None), settings=s)
    torch.testing.assert_close(found.actions, bounds().center.expand(4, 2))
    mean = 0.1 * torch.ones(4, 2, dtype=torch.float64)
    found = plan(ZEROS, draw(s), mean, problem=bad_problem(None), settings=s)
    torch.testing.assert_close(found.actions, mean)


def test_a_broken_actor_does_no_harm():
    s = settings(num_policy_candidates=10)
    problem = point_problem(lambda observation: observation * nan)
    found = plan(ZEROS, draw(s), problem=problem, settings=s)
    assert found.score.isfinite()
    assert found.actions.isfinite().all()
    everything_bad = bad_problem(lambda observation: observation * nan)
    found = plan(ZEROS, draw(s), problem=everything_bad, settings=s)
    torch.testing.assert_close(found.actions, bounds().center.expand(4, 2))


def test_bad_elites_do_not_enter_the_mean():
    """Hardly any candidate is good, so most of the elites are bad."""

    def reward(state, action, reward):
        return torch.where(action[..., 0] > 0.8, reward, nan)

    s = settings(planning_horizon=1, top_k=20, optim_steps=1)
    found = plan(ZEROS, draw(s), problem=point_problem(reward=reward), settings=s)
    assert found.score.isfinite()
    assert found.actions[0, 0] > 0.8


def test_a_sequence_that_is_not_finite_never_wins():
    """Not even where the model makes something of it."""

    class Forgiving(Point):
        def transition(self, state, action):
            return super().transition(state, action.nan_to_num(0.3))

    problem = Problem(Forgiving(), bounds(), lambda observation: observation * nan)
    s = settings(planning_horizon=1, num_policy_candidates=20, select="best")
    assert plan(ZEROS, draw(s), problem=problem, settings=s).actions.isfinite().all()


def test_between_two_bad_ones_the_best_candidate_wins():
    """The actor's own action and the mean of the elites are both where nothing is known."""

    def reward(state, action, reward):
        return torch.where(action[..., 0].abs() > 0.5, reward, nan)

    s = settings(
        planning_horizon=1, optim_steps=1, num_candidates=3, top_k=2, num_policy_candidates=1
    )
    noise = torch.tensor([[0.0, 0.0], [0.9, 0.0], [-0.9, 0.0]], dtype=torch.float64)
    problem = point_problem(torch.zeros_like, goal=0.3, reward=reward)
    found = plan(ZEROS, noise.reshape(1, 1, 3, 2), problem=problem, settings=s)
    torch.testing.assert_close(found.actions[0, 0].item(), 0.9)
    assert found.score.isfinite()


def test_the_actors_own_sequence_competes_once(monkeypatch):
    """Were the best of all counted twice, two elites would be one and the spread would vanish."""
    seen = spy_on_scores(monkeypatch)
    s = settings(
        planning_horizon=1, top_k=2, num_policy_candidates=1, num_kept_elites=1, num_candidates=20
    )
    perfect = point_problem(lambda observation: 0.3 - observation)
    plan(ZEROS, draw(s), problem=perfect, settings=s)
    third_iteration = seen[2][0]
    assert third_iteration.std(1).min() > 1e-6


def test_one_bad_row_of_a_batch_leaves_the_others_alone():
    def reward(state, action, reward):
        return torch.where(state[..., 0] > 50, nan, reward)

    observation = torch.tensor([[0.0, 0.0], [100.0, 0.0], [0.5, 0.0]], dtype=torch.float64)
    s = settings(num_policy_candidates=4)
    noise, problem = draw(s, (3,)), point_problem(half_way, reward=reward)
    whole = plan(observation, noise, problem=problem, settings=s)
    assert whole.score.isfinite().tolist() == [True, False, True]
    alone = plan(observation[2], noise[:, :, :, 2], problem=problem, settings=s)
    torch.testing.assert_close(whole.actions[2], alone.actions)


def test_horizon_one():
    s = settings(planning_horizon=1, num_policy_candidates=5, optim_steps=6)
    problem = point_problem(torch.zeros_like, lambda observation, action: observation[:, 0] * 0.0)
    found = plan(ZEROS, draw(s), problem=problem, settings=s)
    assert found.actions.shape == (1, 2)
    torch.testing.assert_close(
        found.actions, torch.full_like(found.actions, 0.3), atol=0.02, rtol=0
    )


def test_min_std_keeps_later_iterations_apart(monkeypatch):
    seen = spy_on_scores(monkeypatch)
    for floor in (0.0, 0.5):
        s = settings(top_k=1, min_std=floor, optim_steps=2)
        plan(ZEROS, draw(s), problem=point_problem(), settings=s)
    spread = [actions.std(1).max() for actions, _ in seen]
    assert spread[1] < 1e-9
    assert spread[3] > 0.2


def test_the_mean_is_the_first_random_candidate(monkeypatch):
    seen = spy_on_scores(monkeypatch)
    s = settings(num_policy_candidates=3)
    mean = 0.2 * torch.ones(4, 2, dtype=torch.float64)
    plan(ZEROS, draw(s), mean, problem=point_problem(half_way), settings=s)
    torch.testing.assert_close(seen[0][0][:, 3], mean)


def test_unbounded_actions_have_unit_scale():
    free = ActionBounds.from_limits(torch.tensor([-inf, 0.0]), torch.tensor([inf, 4.0]))
    assert free.center.tolist() == [0.0, 2.0]
    assert free.scale.tolist() == [1.0, 2.0]


def test_plans_compile_as_one_graph():
    graphs = []

    def backend(graph, _):
        graphs.append(graph)
        return graph.forward

    torch._dynamo.reset()
    actor = nn.Linear(2, 2, dtype=torch.float64)
    s = settings(num_policy_candidates=10, num_kept_elites=2)
    problem = point_problem(actor, flat_value, wall=1.4)

    def function(observation, noise):
        return plan(observation, noise, problem=problem, settings=s)

    compiled = torch.compile(function, fullgraph=True, backend=backend)
    with torch.no_grad():
        for seed in range(3):
            actor.weight.add_(0.1)  # refreshed in place, as training does
            noise = draw(s, seed=seed)
            torch.testing.assert_close(compiled(ZEROS, noise), function(ZEROS, noise))
    assert len(graphs) == 1


# The module: on tensors, on environments, in pipelines.


def task_parts(name, seed=0):
    torch.manual_seed(seed)
    task = get_task(name)
    model = TaskWorldModel(task, HybridDynamics.hybrid(task))
    observation_dim, action_dim = task.system.observation_dim, task.system.action_dim
    high = torch.tensor(task.action_high)
    actor = TensorDictModule(
        nn.Sequential(
            nn.Linear(observation_dim, 16), nn.ReLU(), nn.Linear(16, action_dim), Scale(high)
        ),
        ["observation"],
        ["action"],
    )
    qvalue = TensorDictModule(
        Concatenate(nn.Linear(observation_dim + action_dim, 2)),
        ["observation", "action"],
        ["state_action_value"],
    )
    return task, WorldModelEnv(model), actor, qvalue


class Scale(nn.Module):
    def __init__(self, high):
        super().__init__()
        self.register_buffer("high", high)

    def forward(self, x):
        return x.tanh() * self.high


class Concatenate(nn.Module):
    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, *inputs):
        return self.network(torch.cat(inputs, -1))


def make_planner(env, actor=None, qvalue=None, **kwargs):
    defaults = {"num_policy_candidates": 8} if actor is not None else {}
    sizes = {"planning_horizon": 4, "optim_steps": 2, "num_candidates": 32, "top_k": 5}
    return CEMPlanner(env, **{**sizes, **defaults, **kwargs}, actor=actor, qvalue=qvalue)


def noise_for(planner, batch=(), seed=0):
    shape = planner.settings.noise_shape(tuple(batch), planner.action_spec.shape.numel())
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_actions_of_any_batch_shape_are_in_bounds(name, batch):
    task, env, actor, qvalue = task_parts(name)
    planner = make_planner(env, actor, qvalue)
    observation = task.system.observe(task.coverage.sample(batch))
    action = planner(TensorDict(observation=observation, batch_size=batch))["action"]
    assert action.shape == (*batch, task.system.action_dim)
    assert (action.abs() <= torch.tensor(task.action_high)).all()
    assert not action.requires_grad
    assert planner.in_keys == ["observation"]
    assert planner.out_keys == ["action"]


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("hybrid", [True, False])
def test_tensors_and_environment_give_the_same_action(name, hybrid):
    """CartPole and Acrobot start where they may end within the horizon."""
    task, env, actor, qvalue = task_parts(name)
    modules = (actor, qvalue) if hybrid else ()
    planners = [make_planner(env, *modules, backend=backend) for backend in ("tensor", "env")]
    assert [planner.uses_tensors for planner in planners] == [True, False]
    observation = task.system.observe(task.coverage.sample((2, 3)))
    tensordict = TensorDict(observation=observation, batch_size=[2, 3])
    noise = noise_for(planners[0], (2, 3))
    plans = [planner.plan(tensordict, noise) for planner in planners]
    torch.testing.assert_close(*(found.actions for found in plans))
    torch.testing.assert_close(*(found.score for found in plans))


def test_compiled_equals_eager():
    torch._dynamo.reset()
    task, env, actor, qvalue = task_parts("cartpole")
    eager = make_planner(env, actor, qvalue)
    compiled = make_planner(env, actor, qvalue, compile={"backend": "aot_eager"})
    for seed in range(2):
        state = task.coverage.sample([3])
        tensordict = TensorDict(observation=task.system.observe(state), batch_size=[3])
        noise = noise_for(eager, (3,), seed)
        torch.testing.assert_close(*(p.plan(tensordict, noise) for p in (eager, compiled)))


@pytest.mark.slow
def test_compiled_by_inductor_equals_eager():
    torch._dynamo.reset()
    task, env, actor, qvalue = task_parts("acrobot-swingup")
    observation = task.system.observe(task.coverage.sample([]))
    tensordict = TensorDict(observation=observation)
    eager, compiled = (make_planner(env, actor, qvalue, compile=c) for c in (False, True))
    noise = noise_for(eager)
    actions = [planner.planning(tensordict, noise) for planner in (eager, compiled)]
    torch.testing.assert_close(*actions, atol=1e-4, rtol=1e-4)


def test_the_same_generator_gives_the_same_actions():
    _, env, actor, qvalue = task_parts("pendulum")
    tensordict = TensorDict(observation=torch.tensor([0.0, 1.0, 0.0]))

    def actions(seed):
        generator = torch.Generator().manual_seed(seed)
        planner = make_planner(env, actor, qvalue, generator=generator)
        return torch.stack([planner(tensordict.clone())["action"] for _ in range(3)])

    assert torch.equal(actions(1), actions(1))
    assert not torch.equal(actions(1), actions(2))


def test_the_oracle_plan_holds_the_cartpole():
    task = get_task("cartpole")
    env = WorldModelEnv(TaskWorldModel(task, HybridDynamics.oracle(task)))
    torch.manual_seed(0)
    planner = CEMPlanner(env, 30, 2, 60, 8)
    assert env.rollout(40, planner)["next", "reward"].sum() == 40


def test_modules_of_every_kind_are_the_same_function():
    _, env, _, _ = task_parts("pendulum")
    network = nn.Linear(3, 1)
    high = torch.tensor([2.0])
    plain = TensorDictModule(nn.Sequential(network, Scale(high)), ["observation"], ["action"])
    chain = TensorDictSequential(
        TensorDictModule(network, ["observation"], ["raw"]),
        TensorDictModule(Scale(high), ["raw"], ["action"]),
    )
    stock = TensorDictSequential(
        TensorDictModule(network, ["observation"], ["action"]),
        TanhModule(in_keys=["action"], low=-2.0, high=2.0),
    )
    hooked = copy.copy(plain)
    hooked._forward_hooks = plain._forward_hooks.copy()
    calls = []
    hooked.register_forward_hook(lambda *_: calls.append(1))
    tensordict = TensorDict(observation=torch.tensor([0.0, 1.0, 0.0]))
    actions = []
    for actor in (plain, chain, stock, hooked):
        for backend in ("tensor", "env"):
            planner = make_planner(env, actor, backend=backend)
            actions.append(planner.planning(tensordict, noise_for(planner)))
    for action in actions[1:]:
        torch.testing.assert_close(action, actions[0])
    assert calls


def test_an_exploring_actor_does_not_explore_in_plans():
    _, env, actor, _ = task_parts("pendulum")
    exploring = TensorDictSequential(actor, AdditiveGaussianModule(env.action_spec))
    tensordict = TensorDict(observation=torch.tensor([0.0, 1.0, 0.0]))
    scores = []
    with set_exploration_type(ExplorationType.RANDOM):
        for module in (actor, exploring):
            planner = make_planner(env, module)
            scores.append(planner.plan(tensordict, noise_for(planner)).score)
    assert torch.equal(*scores)


@pytest.mark.parametrize("stacked", [True, False])
def test_the_smallest_value_counts(stacked):
    task, env, actor, _ = task_parts("pendulum")
    heads = nn.ModuleList(Concatenate(nn.Linear(4, 1)) for _ in range(2))

    class Twin(nn.Module):
        def forward(self, observation, action):
            values = [head(observation, action) for head in heads]
            return torch.stack(values) if stacked else torch.cat(values, -1)

    class Smallest(nn.Module):
        def forward(self, observation, action):
            return torch.minimum(*(head(observation, action) for head in heads))

    keys = ["observation", "action"], ["q"]
    tensordict = TensorDict(observation=task.system.observe(task.reset.sample([3])), batch_size=[3])
    actions = []
    for network in (Twin(), Smallest()):
        planner = make_planner(env, actor, TensorDictModule(network, *keys), value_key="q")
        actions.append(planner.planning(tensordict, noise_for(planner, (3,))))
    assert torch.equal(*actions)


def test_a_copy_has_modules_of_its_own():
    _, env, actor, qvalue = task_parts("pendulum")
    planner = make_planner(env, actor, qvalue, generator=torch.Generator())
    tensordict, noise = TensorDict(observation=torch.tensor([0.0, 1.0, 0.0])), noise_for(planner)
    before = planner.plan(tensordict, noise).score
    other = copy.deepcopy(planner)
    with torch.no_grad():
        for parameter in other.actor.parameters():
            parameter.fill_(10.0)
    assert not torch.equal(other.plan(tensordict, noise).score, before)
    assert torch.equal(planner.plan(tensordict, noise).score, before)


def test_an_actor_may_read_the_models_state():
    """Then the environment is stepped, and needs the state."""
    task, env, _, _ = task_parts("pendulum")
    actor = TensorDictModule(nn.Linear(2, 1), ["state"], ["action"])
    planner = make_planner(env, actor)
    assert not planner.uses_tensors
    assert planner.in_keys == ["observation", "state"]
    assert env.rollout(3, planner)["action"].shape == (3, 1)
    with pytest.raises(ValueError, match="state: expected a tensor"):
        planner(TensorDict(observation=task.system.observe(torch.zeros(2))))


# Several steps of one plan.


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


def scripted(planner, monkeypatch):
    """Plans that count: step k of plan p is 10 p + k. Returns the list of means given."""
    means = []

    def plan_of(tensordict, noise=None, mean=None):
        number, horizon = len(means), planner.settings.planning_horizon
        means.append(mean)
        sequence = 10.0 * number + torch.arange(horizon)
        shape = (*tensordict.batch_size, horizon, 1)
        return pool.Plan(sequence.unsqueeze(-1).expand(shape), torch.zeros(tensordict.batch_size))

    monkeypatch.setattr(planner, "plan", plan_of)
    return means


def test_replan_every(monkeypatch):
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env, replan_every=3)
    means = scripted(planner, monkeypatch)
    tensordict = TensorDict(batch_size=[])
    assert [planner.planning(tensordict).item() for _ in range(7)] == [0, 1, 2, 10, 11, 12, 20]
    planner.reset()
    assert planner.planning(tensordict) == 30
    assert means == [None] * 4


def test_each_row_of_a_batch_has_its_own_episode(monkeypatch):
    _, env, _, _ = task_parts("pendulum")
    planner = make_planner(env, replan_every=3, warm_start=True)
    means = scripted(planner, monkeypatch)
    tensordict = TensorDict(is_init=torch.tensor([[True], [True]]), batch_size=[2])
    actions = [planner.planning(tensordict).flatten().tolist()]
    for second_starts in (False, True, False, False, False):
        tensordict["is_init"] = torch.tensor([[False], [second_starts]])
        actions.append(planner.planning(tensordict).flatten().tolist())
    assert actions == [[0, 0], [1, 1], [2, 10], [20, 11], [21, 12], [22, 30]]
    assert means[0].abs().max() == 0  # nothing to start from
    assert means[1][1].abs().max() == 0  # the row that starts anew
    assert means[2][0].flatten().tolist() == [3, 0, 0, 0]  # the rest of the first plan
    assert means[3][1].flatten().tolist() == [13, 0, 0, 0]
    assert planner.planning(TensorDict(batch_size=[])).item() == 40  # another batch, another life


def test_a_warm_start_remembers():
    task, env, _, _ = task_parts("pendulum-swingup")
    planner = make_planner(env, planning_horizon=15, optim_steps=1, warm_start=True)
    cold = make_planner(env, planning_horizon=15, optim_steps=1)
    tensordict = TensorDict(observation=task.system.observe(torch.tensor([3.0, 0.0])))
    gains = []
    for seed in range(20):
        noise = noise_for(planner, seed=seed)
        planner.reset()
        for _ in range(5):
            planner.planning(tensordict, noise)
        mean = planner.memory._plans
        gains.append(
            planner.plan(tensordict, noise, mean).score - cold.plan(tensordict, noise).score
        )
    assert torch.stack(gains).mean() > 0


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


def test_transforms_are_not_lost(caplog):
    """A transformed environment is stepped, though its base could do without."""
    _, env, _, _ = task_parts("pendulum")
    with caplog.at_level(logging.INFO, logger="phihp_torchrl"):
        planner = make_planner(TransformedEnv(env, RewardScaling(1e3, 1.0)))
    assert not planner.uses_tensors
    assert [record.getMessage() for record in caplog.records] == [
        "CEMPlanner steps the environment: TransformedEnv has no tensor_model of its own."
    ]
    start = env.reset()
    assert planner.plan(start, noise_for(planner)).score > 1e3


def test_what_cannot_compile_says_so(caplog):
    with caplog.at_level(logging.INFO, logger="phihp_torchrl"):
        make_planner(PendulumEnv(), compile=True)
    assert caplog.records[0].levelname == "WARNING"
    assert "which is not compiled" in caplog.records[0].getMessage()
    task = get_task("pendulum")
    model = TaskWorldModel(task, HybridDynamics.oracle(task, integrator="dopri5"))
    planner = make_planner(WorldModelEnv(model), compile=True)
    assert "integrator does not compile" in caplog.records[1].getMessage()
    assert planner.plan(TensorDict(observation=torch.tensor([1.0, 0.0, 0.0]))).score.isfinite()


# Bad input.


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"planning_horizon": 0}, "planning_horizon: expected an integer >= 1, got 0"),
        ({"planning_horizon": 2.0}, "planning_horizon: expected an integer"),
        ({"optim_steps": 0}, "optim_steps"),
        ({"num_candidates": -1}, "num_candidates: expected an integer >= 1, got -1"),
        ({"top_k": 0}, "top_k"),
        ({"top_k": 33}, "top_k: expected at most num_candidates=32, got 33"),
        (
            {"num_policy_candidates": 33},
            "num_policy_candidates: expected at most num_candidates=32",
        ),
        ({"num_policy_candidates": -1}, "num_policy_candidates: expected an integer >= 0"),
        ({"num_kept_elites": 6}, "num_kept_elites: expected at most top_k=5, got 6"),
        ({"policy_noise": -0.1}, "policy_noise: expected a finite number >= 0, got -0.1"),
        ({"policy_noise_clip": nan}, "policy_noise_clip"),
        ({"init_std": 0.0}, "init_std: expected a finite number > 0"),
        ({"min_std": inf}, "min_std"),
        ({"alpha": -1.0}, "alpha"),
        ({"gamma": 1.5}, r"gamma: expected a number in \[0, 1\], got 1.5"),
        ({"select": "median"}, "select: expected 'mean' or 'best', got 'median'"),
        ({"replan_every": 0}, "replan_every: expected 1 to planning_horizon=4, got 0"),
        ({"replan_every": 5}, "replan_every"),
        ({"replan_every": 1.5}, "replan_every: expected an integer"),
        ({"num_policy_candidates": 32, "warm_start": True}, "warm_start"),
        ({"action_key": "torque"}, r"action_key: .* \['action'\], got 'torque'"),
        ({"reward_key": ("next", "pay")}, "reward_key: expected one of"),
        ({"reward_key": "reward"}, "reward_key"),
        ({"observation_key": "obs"}, r"observation_key: expected one of .* got 'obs'"),
        ({"done_keys": [("next", "finished")]}, "done_keys: expected some of"),
        ({"value_key": "q"}, "qvalue: expected a TensorDict module that writes 'q'"),
        ({"backend": "jax"}, "backend: expected 'auto', 'tensor' or 'env', got 'jax'"),
    ],
)
def test_bad_arguments(kwargs, message):
    _, env, actor, qvalue = task_parts("pendulum")
    with pytest.raises(ValueError, match=message):
        make_planner(env, actor, qvalue, **kwargs)


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


# Reduced precision beyond the horizon.


@pytest.mark.parametrize("backend", ["tensor", "env"])
def test_tail_in_bfloat16(backend):
    task, env, actor, qvalue = task_parts("pendulum")
    tensordict = TensorDict(
        observation=task.system.observe(task.coverage.sample([4])), batch_size=[4]
    )
    full, reduced = (
        make_planner(env, actor, qvalue, tail_dtype=dtype, backend=backend)
        for dtype in ("float32", "bfloat16")
    )
    noise = noise_for(full, (4,))
    plans = [planner.plan(tensordict, noise) for planner in (full, reduced)]
    assert plans[1].score.dtype == torch.float32
    assert not torch.equal(plans[0].score, plans[1].score), "the tail is another one"
    torch.testing.assert_close(plans[0].score, plans[1].score, rtol=2e-2, atol=2e-2)


def test_the_last_layer_of_a_reduced_tail_is_exact():
    """A value of 300 in bfloat16 would be off by up to one."""
    task = get_task("pendulum")
    critics = TwinQ(task, (8,))
    with torch.no_grad():
        critics.layers[-1].fill_(300.3)
        critics.layers[-2].zero_()
        with torch.autocast("cpu", torch.bfloat16):
            values = critics(torch.zeros(3, 3), torch.zeros(3, 1))
    assert values.dtype == torch.float32
    assert torch.equal(values, torch.full((3, 2), 300.3))


def test_unknown_tail_dtype():
    with pytest.raises(ValueError, match="tail_dtype: expected 'float32' or 'bfloat16'"):
        settings(tail_dtype="float16")
