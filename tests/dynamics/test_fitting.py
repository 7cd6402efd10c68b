"""Fits find the model: to small errors, to the true constants, and by held-out data."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import HybridDynamics, get_task
from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import DynamicsLoss, FitConfig, fit, perturbed_constants
from phihp_torchrl.systems import Constant, Pendulum
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld, find_plant

PENDULUM = get_task("pendulum")
CARTPOLE = get_task("cartpole-swingup")


def without_friction(task):
    friction = dict.fromkeys(find_plant(task.system).coefficients, 0.0)
    return SimulatedWorld(task, SimulatedConfig(friction=friction))


SMOOTH = without_friction(PENDULUM)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def transitions(world, count, seed=0):
    """Transitions of a task's world, or of a world that one has changed."""
    world = world if isinstance(world, SimulatedWorld) else SimulatedWorld(world)
    task, draws = world.task, generator(seed)
    state = (task.coverage or task.reset).sample([count], generator=draws)
    uniform = 2 * torch.rand(count, task.action_dim, generator=draws) - 1
    return taken(world, state, task.bounds.from_unit(uniform))


def taken(world, state, action):
    observe, size = world.task.observe, [len(state)]
    following = TensorDict(observation=observe(world.step(state, action)), batch_size=size)
    return TensorDict(observation=observe(state), action=action, next=following, batch_size=size)


def make_loss(task, kind="hybrid", seed=0, model_options=None, **options):
    torch.manual_seed(seed)
    guess = perturbed_constants(task.system.constants, 0.3, generator(seed))
    if kind == "data_driven":
        return DynamicsLoss(HybridDynamics.data_driven(task), **options)
    dynamics = getattr(HybridDynamics, kind)(task, constants=guess, **(model_options or {}))
    return DynamicsLoss(dynamics, **options)


def parameters(loss):
    return torch.cat([value.flatten() for value in loss.state_dict().values()])


# How good


def test_levenberg_marquardt_leaves_adam_far_behind():
    train, held_out = transitions(PENDULUM, 300), transitions(PENDULUM, 200, seed=1)
    best = fit(make_loss(PENDULUM), train, held_out, FitConfig(scaled=False), generator())
    assert best.held_out_error < 1e-6
    # A step of Adam costs about a tenth of one of the other.
    config = FitConfig(method="adam", scaled=False, steps=10 * best.steps, batch_size=None)
    adam = fit(make_loss(PENDULUM), train, held_out, config)
    assert adam.held_out_error > 100 * best.held_out_error


def test_cartpole():
    train, held_out = transitions(CARTPOLE, 300), transitions(CARTPOLE, 200, seed=1)
    loss = make_loss(CARTPOLE)
    before = loss(held_out)["loss_prediction"].item()
    report = fit(loss, train, held_out, FitConfig(scaled=False), generator())
    assert report.held_out_error < 1e-4
    assert report.held_out_error < 0.01 * before
    assert report.held_out_error == pytest.approx(loss(held_out)["loss_prediction"].item())
    assert report.train_error == pytest.approx(loss(train)["loss_prediction"].item())


@pytest.mark.parametrize("kind", ["pure_prior", "hybrid"])
@pytest.mark.parametrize("task", [PENDULUM, CARTPOLE], ids=["pendulum", "cartpole"])
def test_constants_are_found(task, kind):
    world = without_friction(task)
    loss = make_loss(task, kind)
    train, held_out = transitions(world, 300), transitions(world, 100, seed=1)
    fit(loss, train, held_out, FitConfig(), generator())
    system = task.system
    truth = system.identifiable(world.truth.constants)
    guess = system.identifiable(perturbed_constants(system.constants, 0.3, generator()))
    found = system.identifiable(loss.dynamics.prior.constants())
    assert any(abs(guess[name] / value - 1) > 0.2 for name, value in truth.items())
    for name, value in truth.items():
        assert found[name].item() == pytest.approx(value, rel=0.01), name


class Bracketed(Pendulum):
    """A pendulum of which one knows the weight, and roughly the length."""

    default_constants = {
        "gravity": Constant(10.0, fixed=True),
        "mass": Constant(1.0, fixed=True),
        "length": Constant(1.4, low=0.5, high=1.5),
    }


@pytest.mark.parametrize("method", ["levenberg_marquardt", "adam"])
def test_bounded_constants_are_found_and_fixed_ones_kept(method):
    task = replace(PENDULUM, name="bracketed", system=Bracketed())
    loss = DynamicsLoss(HybridDynamics.pure_prior(task))
    config = FitConfig(method=method, learning_rate=0.1, steps=60)
    fit(loss, transitions(SMOOTH, 300), transitions(SMOOTH, 100, seed=1), config, generator())
    found = {name: value.item() for name, value in loss.dynamics.prior.constants().items()}
    assert found == pytest.approx({"gravity": 10.0, "mass": 1.0, "length": 1.0}, rel=0.02)
    assert (found["gravity"], found["mass"]) == (10.0, 1.0)


@pytest.mark.parametrize("method", ["levenberg_marquardt", "adam"])
def test_where_all_constants_are_known_the_residual_is_fitted(method):
    class Known(Pendulum):
        default_constants = {
            name: Constant(guess, fixed=True) for name, guess in Pendulum().constants.items()
        }

    task = replace(PENDULUM, name="known", system=Known())
    loss = DynamicsLoss(HybridDynamics.hybrid(task))
    train, held_out = transitions(PENDULUM, 200), transitions(PENDULUM, 100, seed=1)
    before = loss(held_out)["loss_prediction"].item()
    config = FitConfig(method=method, scaled=False, steps=60, learning_rate=1e-2)
    assert fit(loss, train, held_out, config, generator()).held_out_error < 0.1 * before


def test_friction_goes_to_the_residual():
    loss = make_loss(PENDULUM)
    fit(
        loss,
        transitions(PENDULUM, 300),
        transitions(PENDULUM, 100, seed=1),
        FitConfig(),
        generator(),
    )
    state, action = PENDULUM.coverage.sample([200]), torch.zeros(200, 1)
    dynamics, plant = loss.dynamics, find_plant(PENDULUM.system)
    motion = dynamics.derivative(state, action)[:, 1]
    torch.testing.assert_close(motion, plant.derivative(state, action)[:, 1], rtol=0.05, atol=0.1)
    explained = dynamics.residual(state, action)[:, 1]
    correlation = torch.corrcoef(torch.stack([explained, plant.friction(state, action)[:, 1]]))
    assert correlation[0, 1] > 0.95


def test_shuffled_actions_keep_friction_apart_from_torque():
    # A swinging-up controller pushes along the velocity, just as friction pulls against it.
    draws = generator(3)
    state = PENDULUM.coverage.sample([500], generator=draws)
    action = state[:, 1:].sign() + torch.randn(500, 1, generator=draws)
    data = taken(SimulatedWorld(PENDULUM), state, action)
    truth = PENDULUM.system.identifiable(PENDULUM.system.constants)["torque_gain"]

    def error(shuffle):
        loss = make_loss(PENDULUM, model_options={"activation": torch.nn.Tanh})
        fit(loss, data[:400], data[400:], FitConfig(shuffle_actions=shuffle), generator())
        identified = PENDULUM.system.identifiable(loss.dynamics.prior.constants())
        return abs(identified["torque_gain"].item() / truth - 1)

    assert error(shuffle=True) < 0.5 * error(shuffle=False)


def test_data_driven_model_is_fitted_too():
    loss = make_loss(PENDULUM, "data_driven")
    train, held_out = transitions(PENDULUM, 300), transitions(PENDULUM, 100, seed=1)
    report = fit(loss, train, held_out, FitConfig(), generator())
    assert report.held_out_error < 0.01, "of the squared size of a one-step change"


# How


@pytest.mark.parametrize("method", ["levenberg_marquardt", "adam"])
def test_reproducible(method):
    train, held_out = transitions(PENDULUM, 60), transitions(PENDULUM, 20, seed=1)
    config = FitConfig(method=method, steps=4, batch_size=32)

    def fitted(seed):
        loss = make_loss(PENDULUM)
        fit(loss, train, held_out, config, generator(seed))
        return parameters(loss)

    first = fitted(0)
    assert torch.equal(first, fitted(0))
    assert not torch.equal(first, fitted(1)), "mini-batches are drawn from the generator"


def test_generator_alone_is_drawn_from():
    loss = make_loss(PENDULUM)
    before = torch.get_rng_state()
    config = FitConfig(steps=2, batch_size=16)
    fit(loss, transitions(PENDULUM, 60), transitions(PENDULUM, 20), config, generator())
    assert torch.equal(before, torch.get_rng_state())


def test_held_out_transitions_choose():
    # What is learned from another world's data is wrong, and the start is right.
    other = SimulatedWorld(PENDULUM, SimulatedConfig(constants={"mass": 3.0}))
    train, held_out = transitions(other, 100), transitions(SMOOTH, 50, seed=1)
    loss = DynamicsLoss(HybridDynamics.pure_prior(PENDULUM))
    before = loss.dynamics.prior.log_constants.detach().clone()
    config = FitConfig(scaled=False, steps=5)
    assert fit(loss, train, held_out, config, generator()).held_out_error < 1e-8
    assert torch.equal(before, loss.dynamics.prior.log_constants)
    # Adam, which has no such choice, follows the training data.
    adam = replace(config, method="adam", steps=50, learning_rate=0.01)
    assert fit(loss, train, held_out, adam).held_out_error > 1e-6


def test_never_worse_on_held_out_than_the_start():
    train, held_out = transitions(CARTPOLE, 40), transitions(CARTPOLE, 200, seed=1)
    loss = make_loss(CARTPOLE)
    fit(loss, transitions(CARTPOLE, 300, seed=2), held_out, FitConfig(scaled=False, steps=20))
    start = loss(held_out)["loss_prediction"].item()
    report = fit(loss, train, held_out, FitConfig(scaled=False, steps=5))
    assert report.held_out_error <= start


def test_lambda_rises_to_its_end():
    loss = make_loss(PENDULUM)
    train, held_out = transitions(PENDULUM, 60), transitions(PENDULUM, 20, seed=1)
    config = FitConfig(steps=10, initial_lambda=1.0, final_lambda=1e4)
    fit(loss, train, held_out, replace(config, steps=1))
    assert 1.0 < loss.lambda_ <= 1e4
    fit(loss, train, held_out, config)
    assert loss.lambda_.item() == pytest.approx(1e4)


def test_small_lambda_keeps_the_residual_out():
    train, held_out = transitions(PENDULUM, 100), transitions(PENDULUM, 50, seed=1)
    shares = []
    for size in (1e-4, 1e7):
        loss = make_loss(PENDULUM, model_options={"activation": torch.nn.ReLU})
        config = FitConfig(steps=10, initial_lambda=size, final_lambda=size, shuffle_actions=False)
        fit(loss, train, held_out, config)
        state, action, _ = loss.transitions(held_out)
        shares.append(loss.dynamics.residual_share(state, action))
    assert shares[0] < 0.05 < 0.2 < shares[1]


def test_patience_stops():
    loss = DynamicsLoss(HybridDynamics.pure_prior(PENDULUM))
    config = FitConfig(steps=60, patience=2, initial_lambda=1.0, final_lambda=1.0)
    report = fit(loss, transitions(SMOOTH, 50), transitions(SMOOTH, 20, seed=1), config)
    assert report.steps <= 3


def test_scales_are_set_only_if_asked():
    train, held_out = transitions(PENDULUM, 60), transitions(PENDULUM, 20, seed=1)
    for scaled in (False, True):
        loss = make_loss(PENDULUM)
        fit(loss, train, held_out, FitConfig(steps=1, scaled=scaled))
        assert (loss.error_scale != 1).any().item() is scaled


@pytest.mark.parametrize("batch_size", [None, 16])
def test_adam_reduces_the_loss_and_moves_lambda(batch_size):
    loss = make_loss(PENDULUM, lambda_0=10.0, tau_ph=5.0)
    train, held_out = transitions(PENDULUM, 100), transitions(PENDULUM, 50, seed=1)
    before = loss(held_out)["loss_prediction"].item()
    config = FitConfig(
        method="adam", steps=200, scaled=False, batch_size=batch_size, learning_rate=1e-2
    )
    report = fit(loss, train, held_out, config, generator())
    assert report.steps == 200
    assert report.held_out_error < 0.25 * before
    assert loss.lambda_ > 10.0


def test_adam_updates_lambda_once_a_step_with_the_loss_before_it():
    loss = make_loss(PENDULUM, lambda_0=10.0, tau_ph=5.0)
    train = transitions(PENDULUM, 100)
    first = loss(train)["loss_prediction"].item()
    fit(loss, train, train, FitConfig(method="adam", steps=1, scaled=False, batch_size=None))
    assert loss.lambda_.item() == pytest.approx(10.0 + 5.0 * first)


def test_cosine_decay():
    train = transitions(PENDULUM, 50)

    def moved(**options):
        loss = make_loss(PENDULUM, "pure_prior")
        config = FitConfig(method="adam", steps=2, scaled=False, batch_size=None, **options)
        start = loss.dynamics.prior.log_constants.detach().clone()
        fit(loss, train, train, config)
        return (loss.dynamics.prior.log_constants - start).abs().max().item()

    # Adam's first steps are as long as its rate: 1 + 1/2 with the decay, 1 + 1 without.
    assert moved() == pytest.approx(2e-3, rel=0.02)
    assert moved(cosine_decay=True) == pytest.approx(1.5e-3, rel=0.02)


def test_one_transition_is_enough_to_run():
    loss = make_loss(PENDULUM)
    one = transitions(PENDULUM, 1)
    report = fit(loss, one, one, FitConfig(steps=3))
    assert math.isfinite(report.held_out_error)
    assert parameters(loss).isfinite().all()


def test_model_by_adaptive_steps_is_fitted_by_adam_alone():
    loss = DynamicsLoss(HybridDynamics.pure_prior(PENDULUM, integrator="dopri5"))
    data = transitions(PENDULUM, 10)
    with pytest.raises(ValueError, match=r"method.*'adam'.*Dopri5"):
        fit(loss, data, data, FitConfig(steps=1))
    fit(loss, data, data, FitConfig(method="adam", steps=1))


# Errors


@pytest.mark.parametrize("which", ["train", "held_out"])
def test_no_transitions(which):
    data = {"train": transitions(PENDULUM, 5), "held_out": transitions(PENDULUM, 5)}
    data[which] = data[which][:0]
    with pytest.raises(ValueError, match=f"{which}.*at least one"):
        fit(make_loss(PENDULUM), config=FitConfig(), **data)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("key", ["observation", "action", ("next", "observation")])
@pytest.mark.parametrize("which", ["train", "held_out"])
def test_non_finite_transitions(which, key, value):
    data = {"train": transitions(PENDULUM, 5), "held_out": transitions(PENDULUM, 5)}
    data[which][key][2, 0] = value
    loss = make_loss(PENDULUM)
    before = parameters(loss)
    with pytest.raises(ValueError, match=f"{which}.*finite"):
        fit(loss, config=FitConfig(), **data)
    assert torch.equal(before, parameters(loss)), "nothing was changed"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("method", "sgd"),
        ("steps", 0),
        ("patience", 0),
        ("learning_rate", 0.0),
        ("learning_rate", math.nan),
        ("initial_lambda", -1.0),
        ("final_lambda", 0.0),
        ("batch_size", 0),
    ],
)
def test_config_errors_name_the_key(name, value):
    with pytest.raises(ConfigError, match=f"^{name}: expected "):
        FitConfig(**{name: value})


@pytest.mark.parametrize("method", ["levenberg_marquardt", "adam"])
def test_a_prior_of_fixed_constants_is_judged_and_not_fitted(method):
    class Known(Pendulum):
        default_constants = {n: Constant(v, fixed=True) for n, v in Pendulum().constants.items()}

    task = replace(PENDULUM, system=Known())
    loss, data = DynamicsLoss(HybridDynamics.pure_prior(task)), transitions(SMOOTH, 64)
    report = fit(loss, data, data, FitConfig(method=method))
    assert report.steps == 0
    assert report.held_out_error < 1e-6
