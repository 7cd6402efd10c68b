"""The trainers of phases 1 and 2: what they count, keep and resume, to the bit."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymWrapper, StepCounter, TransformedEnv

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.agents import TD3Config, imagined_return
from phihp_torchrl.dynamics import DynamicsLoss, FitConfig, rollout_error, split
from phihp_torchrl.planners.factory import make_planner
from phihp_torchrl.trainers import (
    CollectConfig,
    ModelConfig,
    ModelTrainer,
    PolicyConfig,
    PolicyTrainer,
    StartConfig,
)
from phihp_torchrl.trainers import collect as collect_module
from phihp_torchrl.trainers.collect import make_real_env
from phihp_torchrl.trainers.model import make_dynamics

PENDULUM = get_task("pendulum")
SHORT = replace(PENDULUM, name="short-pendulum", max_steps=15)
COLLECT = CollectConfig(
    planning_horizon=5, replan_every=5, num_candidates=8, top_k=2, optim_steps=1
)
MODEL = ModelConfig(
    real_steps=70,
    steps_per_iteration=25,
    hidden_sizes=(4,),
    fit=FitConfig(steps=2, batch_size=16),
    collect=COLLECT,
)
ADAM = replace(MODEL, fit=FitConfig(method="adam", steps=3, batch_size=16))
POLICY = PolicyConfig(
    updates=12,
    batch_size=8,
    num_worlds=4,
    chunk_steps=2,
    updates_per_step=2,
    replay_capacity=64,
    random_steps=16,
    max_age=5,
    evaluation_interval=4,
    evaluation_episodes=4,
    evaluation_steps=5,
    real_evaluation_episodes=2,
    td3=TD3Config(actor_hidden_sizes=(8, 8), critic_hidden_sizes=(8, 8)),
)


def flat(state):
    """All tensors and numbers of a nested state, by path."""
    if isinstance(state, dict):
        items = state.items()
    elif isinstance(state, (list, tuple)):
        items = enumerate(state)
    else:
        return {"": state}
    return {f"{key}/{path}": v for key, part in items for path, v in flat(part).items()}


def assert_same_state(one, other, but=()):
    one, other = flat(one), flat(other)
    assert one.keys() == other.keys()
    for path, value in one.items():
        if path.rstrip("/") in but:
            continue
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, other[path]), path
        else:
            assert value == other[path], path


def plain(state):
    assert all(
        value is None or isinstance(value, (torch.Tensor, int, float))
        for value in flat(state).values()
    ), "tensors and numbers only, so that a checkpoint needs no pickled code"


# Phase 1


def test_real_steps_are_counted_exactly():
    trainer = ModelTrainer(SHORT, MODEL, seed=0)
    assert trainer.progress == (0, 70)
    assert not trainer.done
    counts = []
    while not trainer.done:
        metrics = trainer.advance()
        counts.append(metrics["real_steps"])
        assert len(trainer.data) == trainer.real_steps == metrics["real_steps"]
    assert counts == [25, 50, 70]
    assert trainer.iteration == MODEL.iterations == 3
    assert trainer.states().shape == (70, 2)


def test_no_more_steps_are_taken_than_counted():
    env = make_real_env(SHORT)
    taken = []
    step = env.base_env._step

    def counted(tensordict):
        taken.append(tensordict["action"].clone())
        return step(tensordict)

    env.base_env._step = counted
    trainer = ModelTrainer(SHORT, MODEL, seed=0, env=env)
    while not trainer.done:
        trainer.advance()
    assert len(taken) == 70
    torch.testing.assert_close(trainer.data["action"], torch.stack(taken).float())


def test_data_are_real_and_in_order():
    trainer = ModelTrainer(SHORT, MODEL, seed=0)
    while not trainer.done:
        trainer.advance()
    data, locate = trainer.data, SHORT.system.locate
    state, action = locate(data["observation"]), data["action"]
    observation = data["next", "observation"]
    expected = SHORT.system.observe(SHORT.step(state, action))
    torch.testing.assert_close(observation, expected, rtol=1e-4, atol=1e-4)
    reward = SHORT.reward(state, action, locate(observation))
    torch.testing.assert_close(data["next", "reward"][:, 0], reward, rtol=1e-4, atol=1e-4)
    goes_on = ~data["next", "done"][:-1, 0]
    assert torch.equal(observation[:-1][goes_on], data["observation"][1:][goes_on])
    jumps = (observation[:-1] != data["observation"][1:]).any(-1).nonzero().flatten().tolist()
    # Episodes of 15 steps, and a new one for each of the iterations, of 25, 25 and 20 steps.
    assert jumps == [14, 24, 39, 49, 64]


def test_the_seed_makes_the_run():
    def states(seed):
        torch.manual_seed(0)  # of the networks' weights
        trainer = ModelTrainer(SHORT, MODEL, seed=seed)
        for _ in range(2):
            trainer.advance()
        return trainer.states()

    first = states(0)
    assert torch.equal(first, states(0))
    assert not torch.equal(first, states(1))


def test_the_planner_collects_from_the_second_iteration_on(monkeypatch):
    made = []

    def spy(*args, **kwargs):
        made.append(make_planner(*args, **kwargs))
        return made[-1]

    monkeypatch.setattr(collect_module, "make_planner", spy)
    trainer = ModelTrainer(SHORT, MODEL, seed=0)
    trainer.advance()
    assert made == []
    trainer.advance()
    assert len(made) == 1
    assert made[0].settings.num_candidates == 8
    assert made[0].memory is not None, "a plan is acted on for several steps"


def test_a_collecting_plan_that_cannot_be_is_refused_at_once():
    for change in ({"replan_every": 9}, {"top_k": 9}, {"planning_horizon": 0}):
        with pytest.raises(ValueError, match=next(iter(change))):
            replace(COLLECT, **{"planning_horizon": 8, "num_candidates": 8, **change})


def push_reward(state, action, next_state):
    return action[..., 0]


@pytest.mark.parametrize("explore", [True, False])
def test_planned_steps_pursue_the_reward(explore):
    rewards = {"exploration_reward": push_reward, "reward": lambda s, a, n: -push_reward(s, a, n)}
    task = replace(PENDULUM, **rewards)
    collect = replace(COLLECT, num_candidates=64, optim_steps=3, noise=0.0)
    collect = replace(collect, exploration_reward=explore)
    config = ModelConfig(real_steps=40, steps_per_iteration=20, kind="oracle", collect=collect)
    trainer = ModelTrainer(task, config, seed=0)
    trainer.advance()
    trainer.advance()
    at_random, planned = trainer.data["action"].split(20)
    assert at_random.mean().abs() < 0.8
    assert (planned.mean() if explore else -planned.mean()) > 1.0


def test_random_actions_are_held_and_bounded():
    config = replace(MODEL, collect=replace(COLLECT, random_hold=5))
    trainer = ModelTrainer(PENDULUM, config, seed=0)
    action = trainer.collect(25)["action"]
    groups = action.reshape(5, 5)
    assert (groups == groups[:, :1]).all()
    assert len(groups.unique()) == 5
    assert (action.abs() <= 2).all()


def test_planned_actions_are_bounded_under_noise():
    config = replace(MODEL, collect=replace(COLLECT, noise=5.0))
    trainer = ModelTrainer(PENDULUM, config, seed=0)
    for _ in range(2):
        trainer.advance()
    planned = trainer.data["action"][25:]
    assert (planned.abs() <= 2).all()
    assert (planned.abs() == 2).float().mean() > 0.5


@pytest.mark.parametrize("kind", ["hybrid", "data_driven", "prior", "oracle"])
def test_metrics(kind):
    trainer = ModelTrainer(SHORT, replace(MODEL, kind=kind), seed=0)
    metrics = trainer.advance()
    assert all(isinstance(value, float) and math.isfinite(value) for value in metrics.values())
    expected = {"real_steps", "collect/reward"}
    if kind != "oracle":
        names = ("train_error", "held_out_error", "fit_steps", "fit_seconds", "lambda")
        expected |= {f"model/{name}" for name in (*names, "residual_share")}
    if kind in ("hybrid", "prior"):
        expected |= {"constants/gravity_gain", "constants/torque_gain"}
    assert set(metrics) == expected
    if kind == "hybrid":
        constants = trainer.dynamics.prior.constants()
        gain = 1.5 * constants["gravity"] / constants["length"]
        assert metrics["constants/gravity_gain"] == pytest.approx(gain.item())


def test_the_model_gets_better():
    config = replace(
        MODEL, real_steps=100, steps_per_iteration=100, hidden_sizes=(8,), fit=FitConfig(steps=20)
    )
    trainer = ModelTrainer(PENDULUM, config, seed=0)
    untrained = copy.deepcopy(trainer.dynamics)
    trainer.advance()
    state = PENDULUM.reset.sample([50])
    action = torch.zeros(50, 1)
    truth = PENDULUM.step(state, action)
    before, after = ((m(state, action) - truth).norm() for m in (untrained, trainer.dynamics))
    assert after < 0.1 * before


@pytest.mark.parametrize("config", [MODEL, ADAM, replace(MODEL, warm_start=False)])
@pytest.mark.parametrize("done_before", [0, 1, 2])
def test_a_resumed_model_run_is_the_same_run(config, done_before):
    torch.manual_seed(0)
    whole = ModelTrainer(SHORT, config, seed=0)
    torch.manual_seed(0)
    first = ModelTrainer(SHORT, config, seed=0)
    for _ in range(done_before):
        whole.advance()
        first.advance()
    saved = copy.deepcopy(first.state_dict())
    plain(saved)
    torch.manual_seed(7)
    resumed = ModelTrainer(SHORT, config, seed=7)
    resumed.load_state_dict(saved)
    assert_same_state(saved, resumed.state_dict())
    assert resumed.progress == first.progress
    while not whole.done:
        expected, metrics = whole.advance(), resumed.advance()
        assert {k: v for k, v in metrics.items() if "seconds" not in k} == {
            k: v for k, v in expected.items() if "seconds" not in k
        }
    assert resumed.done
    assert_same_state(whole.state_dict(), resumed.state_dict())


def test_cold_fits_begin_at_the_beginning():
    config = replace(MODEL, warm_start=False, fit=replace(ADAM.fit, learning_rate=1e-12))
    trainer = ModelTrainer(SHORT, config, seed=0)
    start = trainer.dynamics.prior.log_constants.detach().clone()
    trainer.advance()
    with torch.no_grad():
        trainer.dynamics.prior.log_constants.add_(1.0)
    trainer.advance()
    torch.testing.assert_close(trainer.dynamics.prior.log_constants.detach(), start)


def test_first_guess_is_wrong_by_the_error():
    generator = torch.Generator().manual_seed(0)
    dynamics = make_dynamics(PENDULUM, replace(MODEL, constants_error=0.2), generator)
    for name, value in dynamics.prior.constants().items():
        ratio = value.item() / PENDULUM.system.constants[name]
        assert abs(ratio - 1) == pytest.approx(0.2, rel=1e-4)


def test_custom_environment():
    env = TransformedEnv(GymWrapper(make_real_env(SHORT).base_env._env), StepCounter())
    trainer = ModelTrainer(SHORT, MODEL, seed=0, env=env)
    trainer.advance()
    assert trainer.real_steps == 25


# Held-out blocks


def numbered(count, ends=()):
    number = torch.arange(count).float().unsqueeze(-1)
    done = torch.zeros(count, 1, dtype=torch.bool)
    done[list(ends)] = True
    following = TensorDict(done=done, batch_size=[count])
    return TensorDict(number=number, next=following, batch_size=[count])


def numbers(data):
    return data["number"][..., 0].int().tolist()


def test_every_tenth_block_is_held_out():
    train, held_out, blocks = split(numbered(400))
    assert numbers(held_out) == [*range(180, 200), *range(380, 400)]
    assert numbers(train) == [*range(180), *range(200, 380)]
    assert numbers(blocks) == [list(range(180, 200)), list(range(380, 400))]


def test_an_unfinished_block_is_held_out_but_no_rollout():
    train, held_out, blocks = split(numbered(390))
    assert numbers(held_out) == [*range(180, 200), *range(380, 390)]
    assert len(train) == 360
    assert numbers(blocks) == [list(range(180, 200))]
    _, held_out, blocks = split(numbered(190))
    assert numbers(held_out) == list(range(180, 190))
    assert blocks is None


def test_blocks_are_whole_episodes_parts():
    *_, blocks = split(numbered(600, ends=[185, 399]))
    # One that ends before its last step is broken, one that ends with it is not.
    assert numbers(blocks) == [list(range(380, 400)), list(range(580, 600))]
    *_, blocks = split(numbered(200, ends=[190]))
    assert blocks is None


@pytest.mark.parametrize("count", [1, 2, 9, 10, 25, 180])
def test_few_transitions_are_split_too(count):
    train, held_out, blocks = split(numbered(count))
    assert blocks is None
    if count >= 10:
        assert numbers(held_out) == list(range(9, count, 10))
    else:
        assert numbers(held_out) == [count - 1]
    if count > 1:
        assert sorted(numbers(train) + numbers(held_out)) == list(range(count))
    else:
        assert numbers(train) == [0], "one transition serves as both"


def test_iterations_are_not_joined_to_one_block():
    # Blocks [180, 200) with a boundary between iterations at 190.
    config = replace(MODEL, real_steps=200, steps_per_iteration=95, kind="oracle")
    trainer = ModelTrainer(PENDULUM, config, seed=0)
    while not trainer.done:
        trainer.advance()
    *_, blocks = split(trainer.data)
    assert blocks is None


def test_rollout_error_by_hand():
    # A model of standing still is off by the whole way.
    class Standstill(torch.nn.Module):
        def forward(self, state, action):
            return torch.zeros_like(state)

    observe = PENDULUM.system.observe
    state = torch.zeros(2, 20, 2)
    next_state = torch.zeros(2, 20, 2)
    next_state[0, -1] = torch.tensor([0.3, 0.4])
    next_state[1, -1] = torch.tensor([0.0, 1.5])
    blocks = TensorDict(
        observation=observe(state),
        action=torch.zeros(2, 20, 1),
        next=TensorDict(observation=observe(next_state), batch_size=[2, 20]),
        batch_size=[2, 20],
    )
    loss = DynamicsLoss(HybridDynamics(PENDULUM, prior=Standstill(), residual=None))
    assert rollout_error(loss, blocks).item() == pytest.approx((0.5 + 1.5) / 2)


# Phase 2


def policy_trainer(config=POLICY, seed=0, dynamics=None, **options):
    torch.manual_seed(seed)
    dynamics = HybridDynamics.hybrid(PENDULUM) if dynamics is None else dynamics
    return PolicyTrainer(PENDULUM, dynamics, config, seed=seed, **options)


@pytest.mark.parametrize("done_before", [0, 1, 2])
def test_a_resumed_policy_run_is_the_same_run(done_before):
    # Chunks of four updates, evaluations after six, so that a checkpoint may fall inside a chunk.
    config = replace(POLICY, updates=18, evaluation_interval=6)
    whole, first = policy_trainer(config), policy_trainer(config)
    dynamics = first.world_model.dynamics.module
    for _ in range(done_before):
        whole.advance()
        first.advance()
    saved = copy.deepcopy(first.state_dict())
    plain(saved)
    resumed = policy_trainer(config, seed=7, dynamics=copy.deepcopy(dynamics))
    resumed.load_state_dict(saved)
    assert_same_state(saved, resumed.state_dict())
    while not whole.done:
        expected, metrics = whole.advance(), resumed.advance()
        for key in expected.keys() - {"policy/seconds"}:
            assert metrics[key] == expected[key], key
    assert resumed.done
    assert_same_state(whole.state_dict(), resumed.state_dict(), but=["seconds"])


def test_work_is_counted():
    trainer = policy_trainer()
    assert trainer.progress == (0, 12)
    counts = []
    while not trainer.done:
        metrics = trainer.advance()
        counts.append((metrics["policy/updates"], metrics["policy/imagined_steps"]))
        assert all(math.isfinite(value) for value in metrics.values())
    # Two chunks of 2 steps in 4 worlds are random and precede the first; then one for 4 updates.
    assert counts == [(4, 24), (8, 32), (12, 40)]
    assert trainer.update.steps == 6, "of two critic updates each"
    assert set(metrics) == {
        f"policy/{name}"
        for name in (
            "updates",
            "imagined_steps",
            "imagined_return",
            "best_imagined_return",
            "real_return",
            "seconds",
            "loss_qvalue",
            "loss_actor",
        )
    }


def test_the_best_actor_is_kept():
    rates = replace(POLICY.td3, actor_learning_rate=0.1)  # wild enough to get worse now and then
    trainer = policy_trainer(replace(POLICY, updates=40, td3=rates))
    returns, actors = [], []
    while not trainer.done:
        returns.append(trainer.advance()["policy/imagined_return"])
        actors.append([layer.clone() for layer in trainer.update.actor])
    best = max(range(len(returns)), key=returns.__getitem__)
    assert trainer.best_return == max(returns)
    kept = [p.detach() for p in trainer.best_actor().module.mlp.parameters()]
    for layer, expected in zip(kept, actors[best], strict=True):
        assert torch.equal(layer, expected)
    score = imagined_return(
        trainer.world_model, kept, trainer._evaluation_states[:4], torch.tensor([2.0]), 5
    )
    assert score.mean().item() == pytest.approx(trainer.best_return)


def test_kept_actor_and_critics_stand_still():
    trainer = policy_trainer()
    trainer.advance()
    actor, critics = trainer.best_actor(), trainer.best_qvalue()
    before = [p.clone() for p in (*actor.parameters(), *critics.parameters())]
    while not trainer.done:
        trainer.advance()
    after = (*actor.parameters(), *critics.parameters())
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_actor_and_critics_are_modules_of_the_keys():
    trainer = policy_trainer()
    trainer.advance()
    data = trainer.best_actor()(TensorDict(observation=torch.randn(5, 3), batch_size=[5]))
    assert data["action"].shape == (5, 1)
    assert (data["action"].abs() <= 2).all()
    assert trainer.best_qvalue()(data)["state_action_value"].shape == (5, 2)
    current = trainer.actor()(TensorDict(observation=torch.randn(5, 3), batch_size=[5]))
    assert current["action"].shape == (5, 1)


def test_a_model_that_explodes_keeps_the_first_actor():
    class Explosive(torch.nn.Module):
        def forward(self, state, action):
            return torch.full_like(state, math.nan)

    trainer = policy_trainer(dynamics=Explosive())
    first = [layer.clone() for layer in trainer.update.actor]
    trainer.advance()
    assert all(layer.isfinite().all() for layer in trainer.update.actor)
    kept = list(trainer.best_actor().parameters())
    assert all(torch.equal(a, b) for a, b in zip(first, kept, strict=True))


def test_the_real_world_has_no_say():
    trainer = policy_trainer(replace(POLICY, real_evaluation_episodes=0))
    assert "policy/real_return" not in trainer.advance()
    worlds = []
    for friction in (0.5, 5.0):
        system = type(PENDULUM.system)(friction_constants={"joint": friction})
        torch.manual_seed(0)
        dynamics = HybridDynamics.hybrid(PENDULUM)
        worlds.append(PolicyTrainer(replace(PENDULUM, system=system), dynamics, POLICY, seed=0))
        while not worlds[-1].done:
            metrics = worlds[-1].advance()
        worlds[-1].real_return = metrics["policy/real_return"]
    one, other = worlds
    assert one.real_return != other.real_return
    assert_same_state(one.state_dict(), other.state_dict(), but=["seconds"])


def test_seconds_stop():
    trainer = policy_trainer(replace(POLICY, max_seconds=1e-6))
    assert not trainer.done
    trainer.advance()
    assert trainer.done
    assert trainer.updates == 4
    assert trainer.seconds > 1e-6


def test_the_model_is_not_changed():
    dynamics = HybridDynamics.hybrid(PENDULUM)
    before = copy.deepcopy(dynamics.state_dict())
    trainer = policy_trainer(dynamics=dynamics)
    while not trainer.done:
        trainer.advance()
    assert_same_state(before, dynamics.state_dict())


def test_the_policy_gets_better():
    task = replace(PENDULUM, reward=lambda s, a, n: -(a[..., 0] - 1.0).square())
    rates = replace(POLICY.td3, critic_learning_rate=1e-2, actor_learning_rate=1e-2, gamma=0.5)
    config = replace(
        POLICY, updates=200, batch_size=32, updates_per_step=5, evaluation_interval=50, td3=rates
    )
    trainer = PolicyTrainer(task, HybridDynamics.oracle(task), config, seed=0)
    states, high = task.reset.sample([4]), torch.tensor([2.0])
    untrained = imagined_return(trainer.world_model, trainer.update.actor, states, high, 5).mean()
    while not trainer.done:
        trainer.advance()
    assert trainer.best_return > 0.3 * untrained


def test_lives_start_in_real_data():
    states = torch.tensor([[0.5, 3.0], [-0.5, -3.0]])
    config = replace(POLICY, start=StartConfig(reset=0, data=1, coverage=0, goal=0), max_age=1)
    trainer = policy_trainer(config, data_states=states)
    trainer.advance()
    seen = trainer.replay.rows[: len(trainer.replay), :2].unique(dim=0)
    assert torch.equal(seen, states.flip(0))


def test_data_states_must_be_given():
    with pytest.raises(ValueError, match="data"):
        policy_trainer(replace(POLICY, start=StartConfig(data=0.5)))


def test_lives_begin_at_all_ages():
    trainer = policy_trainer(replace(POLICY, num_worlds=500, max_age=5))
    assert trainer.worlds.age.unique().tolist() == [0, 1, 2, 3, 4]
    assert policy_trainer(replace(POLICY, max_age=None)).max_age == PENDULUM.max_steps


def test_rates_decay_at_the_end(monkeypatch):
    trainer = policy_trainer(replace(POLICY, updates=40, evaluation_interval=40, decay=0.5))
    scales, update = [], type(trainer.update).forward

    def watched(self, batch, scale, generator):
        scales.append(scale)
        return update(self, batch, scale, generator)

    monkeypatch.setattr(type(trainer.update), "forward", watched)
    trainer.advance()
    expected = [1.0] * 11 + [1 - k / 10 for k in range(1, 10)]
    assert scales == pytest.approx(expected)


# Configuration


@pytest.mark.parametrize(
    ("make", "name", "value"),
    [
        (ModelConfig, "real_steps", 0),
        (ModelConfig, "steps_per_iteration", 0),
        (ModelConfig, "refit_steps", 0),
        (ModelConfig, "kind", "none"),
        (ModelConfig, "activation", "step"),
        (ModelConfig, "residual_outputs", "some"),
        (CollectConfig, "noise", -0.1),
        (CollectConfig, "noise", math.nan),
        (CollectConfig, "random_hold", 0),
        (PolicyConfig, "updates", 0),
        (PolicyConfig, "batch_size", 0),
        (PolicyConfig, "num_worlds", 0),
        (PolicyConfig, "chunk_steps", 0),
        (PolicyConfig, "updates_per_step", 0),
        (PolicyConfig, "replay_capacity", 0),
        (PolicyConfig, "evaluation_interval", 0),
        (PolicyConfig, "evaluation_episodes", 0),
        (PolicyConfig, "random_fraction", 1.5),
        (PolicyConfig, "random_fraction", math.nan),
        (PolicyConfig, "decay", -0.5),
        (PolicyConfig, "random_steps", -1),
        (PolicyConfig, "exploration_noise", -0.1),
        (PolicyConfig, "real_evaluation_episodes", -1),
        (PolicyConfig, "max_age", 0),
        (PolicyConfig, "evaluation_steps", 0),
        (PolicyConfig, "max_seconds", 0.0),
        (PolicyConfig, "evaluation_interval", 501),
    ],
)
def test_config_errors_name_the_key(make, name, value):
    with pytest.raises(ValueError, match=f"^{name}:"):
        make(**{name: value})


def test_chunks_hold_whole_updates():
    with pytest.raises(ValueError, match="policy_delay"):
        PolicyConfig(chunk_steps=1, updates_per_step=3)


@pytest.mark.parametrize(
    ("config", "name"),
    [
        (replace(MODEL, constants_error=1.5), "error"),
        (replace(MODEL, integrator="euler"), "integrator"),
        (replace(MODEL, lambda_0=-1.0), "lambda_0"),
        (replace(MODEL, tau_ph=-1.0), "tau_ph"),
        (replace(MODEL, hidden_sizes=()), "hidden_sizes"),
    ],
)
def test_a_trainer_refuses_at_once(config, name):
    with pytest.raises(ValueError, match=name):
        ModelTrainer(PENDULUM, config, seed=0)


def test_periods():
    assert ModelConfig(real_steps=5000).period == 500
    assert ModelConfig(real_steps=5000).iterations == 10
    assert ModelConfig(real_steps=120).period == 50
    assert ModelConfig(real_steps=120).iterations == 3
    assert ModelConfig(real_steps=2000, steps_per_iteration=300).iterations == 7
