"""The world that a caller means: by name, settings, environment, function, or itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import gymnasium
import pytest
import torch
from torchrl.envs import GymWrapper

from phihp_torchrl import get_task, load_config, make_world, register_world
from phihp_torchrl.config import ConfigError
from phihp_torchrl.worlds import (
    WORLDS,
    EnvWorld,
    GymnasiumConfig,
    GymnasiumWorld,
    SimulatedConfig,
    SimulatedWorld,
    TorchRLConfig,
    World,
)

PENDULUM = get_task("pendulum")


def make_gym():
    return gymnasium.make("Pendulum-v1")


def make_torchrl():
    return GymWrapper(make_gym())


@pytest.mark.parametrize(
    ("given", "kind", "label"),
    [
        ("simulated", SimulatedWorld, "simulated"),
        ({"kind": "simulated", "integrator": "rk4"}, SimulatedWorld, "simulated"),
        ({"integrator": "rk4"}, SimulatedWorld, "simulated"),
        (SimulatedConfig(substeps=2), SimulatedWorld, "simulated"),
        ({"kind": "gymnasium", "id": "Pendulum-v1"}, GymnasiumWorld, "gymnasium Pendulum-v1"),
        (GymnasiumConfig("Pendulum-v1"), GymnasiumWorld, "gymnasium Pendulum-v1"),
        ({"kind": "torchrl", "make": "math:sin"}, EnvWorld, "torchrl math:sin"),
        (TorchRLConfig("math:sin"), EnvWorld, "torchrl math:sin"),
        (make_torchrl, EnvWorld, "make_torchrl"),
        (make_gym, EnvWorld, "make_gym"),
    ],
)
def test_a_world_is_made_of_what_is_given(given, kind, label):
    for task in (PENDULUM, "pendulum"):
        world = make_world(task, given)
        assert type(world) is kind
        assert world.task is PENDULUM
        assert str(world) == label


@pytest.mark.parametrize("make", [make_gym, make_torchrl])
@pytest.mark.parametrize("called", [False, True])
def test_environments_and_functions_that_make_them_are_worlds(make, called):
    world = make_world(PENDULUM, make() if called else make)
    data = world.make_env().rollout(3)
    assert data["observation"].shape == (3, 3)
    assert data["next", "step_count"].flatten().tolist() == [1, 2, 3]


def test_the_simulated_world_is_the_default():
    assert next(iter(WORLDS)) == "simulated"
    assert type(make_world("pendulum")) is SimulatedWorld


def test_a_world_is_itself():
    world = SimulatedWorld("pendulum")
    assert make_world("pendulum", world) is world


def test_a_world_of_another_task_is_refused():
    message = "^world: expected a world of task 'acrobot', got one of 'pendulum'\\.$"
    with pytest.raises(ConfigError, match=message):
        make_world("acrobot", SimulatedWorld(PENDULUM))


def test_settings_reach_the_world():
    world = make_world("pendulum", {"integrator": "rk4", "substeps": 3, "friction": {"joint": 0.1}})
    assert world.integrator.settings == {"substeps": 3}
    assert world.truth.coefficients == {"joint": 0.1}
    options = {"kind": "gymnasium", "id": "Pendulum-v1", "options": {"g": 1.6}}
    assert make_world("pendulum", options).config.options == {"g": 1.6}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            "magic",
            r"world: expected one of \['given', 'gymnasium', 'recorded', 'simulated', .*'magic'",
        ),
        ({"kind": "magic"}, r"world\.kind: expected one of .*'magic'"),
        ({"kind": "gymnasium"}, r"world\.id: missing"),
        ({"kind": "gymnasium", "idd": "x"}, r"world\.idd: unknown key; did you mean 'id'\?"),
        ({"kind": "torchrl", "make": "nothing"}, r"world\.make: expected module:function"),
        ({"substeps": 0}, r"world\.substeps: expected a whole number"),
        ({"kind": "given"}, r"world\.kind: this run was started from Python with a world of its"),
        ("given", r"world\.kind: this run was started from Python with a world of its own"),
        (3, r"world: expected one of .*, settings, an environment, a function that .*, got 3\."),
        (None, r"world: expected one of .*, got None\."),
    ],
)
def test_what_is_no_world_is_named(given, message):
    with pytest.raises(ConfigError, match=f"^{message}"):
        make_world("pendulum", given)


def test_an_unknown_task_is_named():
    with pytest.raises(ConfigError, match=r"^task: expected one of .*'unicycle'"):
        make_world("unicycle")


# A kind of one's own


@dataclass(frozen=True)
class TunnelConfig:
    kind: ClassVar[str] = "tunnel"

    wind: float
    gusts: int = 2


class Tunnel(World):
    kind = "tunnel"

    def __init__(self, task, config):
        super().__init__(task)
        self.config = config

    def make_env(self, *, render=False):
        return SimulatedWorld(self.task).make_env(render=render)


@pytest.mark.usefixtures("registries")
def test_a_kind_of_the_users_own():
    kind = register_world("tunnel", TunnelConfig, Tunnel, about="a wind tunnel")
    assert WORLDS["tunnel"] is kind
    assert kind.about == "a wind tunnel"
    for given in ({"kind": "tunnel", "wind": 3.0}, TunnelConfig(3.0)):
        world = make_world("pendulum", given)
        assert isinstance(world, Tunnel)
        assert (world.config, str(world)) == (TunnelConfig(3.0, 2), "tunnel")
        assert (world.truth, world.model()) == (None, None)
        env = world.make_env()
        assert world.picture(env) is None
        assert torch.isfinite(env.rollout(2)["observation"]).all()
    with pytest.raises(ConfigError, match=r"^world\.wind: missing"):
        make_world("pendulum", "tunnel")
    with pytest.raises(ConfigError, match=r"^world: 'tunnel' is registered already"):
        register_world("tunnel", TunnelConfig, Tunnel)
    register_world("tunnel", TunnelConfig, Tunnel, replace=True)
    settings = load_config("pendulum", overrides=["world=tunnel", "world.wind=4.5"])
    assert settings["world"] == {"kind": "tunnel", "wind": 4.5, "gusts": 2}
    assert make_world("pendulum", settings["world"]).config == TunnelConfig(4.5)
