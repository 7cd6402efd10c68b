"""Plants: which one a system has, what is checked of it, and its place in a model."""

from __future__ import annotations

import math
from typing import ClassVar

import pytest
import torch
from physics import all_systems, random_transition

from phihp_torchrl.config import ConfigError
from phihp_torchrl.dynamics import PRIORS
from phihp_torchrl.systems import Constant, Pendulum, System
from phihp_torchrl.worlds import Plant, PlantPhysics, find_plant, register_plant

from ..sled import Sled


class Brake(Plant):
    """A sled on something rough."""

    default_coefficients: ClassVar = {"drag": 0.5}

    def friction(self, state, action):
        drag = -self.coefficients["drag"] * state[..., 1] / self.constants["mass"]
        return torch.stack([torch.zeros_like(drag), drag], -1)


class Unknown(System):
    """A system without equations."""

    state_names, action_names = ("x", "v"), ("force",)


class Found(Plant):
    """The equations that it nevertheless has."""

    def derivative(self, state, action):
        return torch.stack([state[..., 1], action[..., 0]], -1)


def test_a_system_without_a_plant_is_its_own_equations():
    plant = find_plant(Sled())
    assert type(plant) is Plant
    state, action = random_transition(Sled())
    assert torch.equal(plant.friction(state, action), torch.zeros_like(state))
    prior = Sled().prior(state, action, Sled().constants)
    assert torch.equal(plant.derivative(state, action), prior)


@pytest.mark.usefixtures("registries")
def test_a_plant_of_the_users_own_serves_subclasses_and_is_replaced_by_a_later_one():
    class Bob(Sled):
        pass

    assert register_plant(Sled, Brake) is Brake
    assert type(find_plant(Sled())) is type(find_plant(Bob())) is Brake
    register_plant(Bob, Found)
    assert type(find_plant(Bob())) is Found
    assert type(find_plant(Sled())) is Brake
    register_plant(Sled, Plant)
    assert type(find_plant(Sled())) is Plant


@pytest.mark.usefixtures("registries")
def test_constants_and_coefficients_may_differ():
    register_plant(Sled, Brake)
    plant = find_plant(Sled(), {"mass": 4.0}, {"drag": 2.0})
    state, action = torch.tensor([0.0, 1.0]), torch.tensor([6.0])
    assert plant.derivative(state, action).tolist() == [1.0, (6.0 - 2.0) / 4.0]
    assert find_plant(Sled()).derivative(state, action).tolist() == [1.0, (6.0 - 0.5) / 2.0]


@pytest.mark.usefixtures("registries")
def test_a_system_without_equations_needs_a_plant_that_has_them():
    with pytest.raises(ConfigError, match=r"^system: Unknown has no prior.*register_plant"):
        find_plant(Unknown())
    register_plant(Unknown, Found)
    rate = find_plant(Unknown()).derivative(torch.tensor([1.0, 2.0]), torch.tensor([3.0]))
    assert rate.tolist() == [2.0, 3.0]


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
@all_systems
def test_friction_must_not_push(kind, value):
    name = next(iter(find_plant(kind()).coefficients))
    with pytest.raises(ConfigError, match=rf"^coefficients\.{name}: expected a "):
        find_plant(kind(), coefficients={name: value})


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
@all_systems
def test_true_constants_must_be_positive_and_finite(kind, value):
    name = next(iter(kind().constants))
    with pytest.raises(ConfigError, match=rf"^constants\.{name}: expected a "):
        find_plant(kind(), {name: value})


def test_constants_that_may_be_negative_may_be_so_in_truth():
    class Tilted(Sled):
        default_constants: ClassVar = {"mass": 2.0, "tilt": Constant(0.0, low=-0.5, high=0.5)}

    assert find_plant(Tilted(), {"tilt": -0.75}).constants["tilt"] == -0.75  # beyond what is known


def test_unknown_names_are_told():
    with pytest.raises(ConfigError, match=r"^constants: unknown \['wind'\], expected some of"):
        find_plant(Pendulum(), {"wind": 1.0})
    with pytest.raises(ConfigError, match=r"^coefficients: unknown \['wind'\], expected some of"):
        find_plant(Pendulum(), coefficients={"wind": 1.0})


@all_systems
def test_the_prior_never_reads_the_truth(kind):
    system = kind()
    truth = find_plant(
        system,
        {name: 2 * value for name, value in system.constants.items()},
        {name: 10 * value + 1 for name, value in find_plant(system).coefficients.items()},
    )
    state, action = random_transition(system)
    guess = kind().constants
    assert system.constants == guess
    prior = truth.system.prior(state, action, guess)
    assert torch.equal(prior, kind().prior(state, action, guess))
    declared = find_plant(kind())
    assert not torch.equal(truth.friction(state, action), declared.friction(state, action))


@all_systems
def test_its_physics_take_the_place_of_a_prior_and_are_built_again(kind):
    plant = find_plant(kind(), coefficients=dict.fromkeys(find_plant(kind()).coefficients, 0.3))
    state, action = random_transition(kind())
    physics = PlantPhysics(plant)
    assert torch.equal(physics(state, action), plant.derivative(state, action))
    assert list(physics.parameters()) == []
    again = PRIORS.find(physics.config["kind"]).from_config(kind(), physics.config)
    assert isinstance(again, PlantPhysics)
    assert again.config == physics.config
    assert torch.equal(again(state, action), physics(state, action))
