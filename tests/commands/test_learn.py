"""``learn(task, world)``: what the command does with the same words, from Python."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gymnasium
import pytest
import yaml

import phihp_torchrl
from phihp_torchrl import ConfigError, Learned, get_task, learn, load_config
from phihp_torchrl.config import flatten, override_lines
from phihp_torchrl.tasks import list_tasks
from phihp_torchrl.worlds import SimulatedConfig, SimulatedWorld

from .command_parts import FAST, PLUGIN, metrics_column
from .conftest import Command


def weights(run: Path) -> bytes:
    return (run / "agent" / "weights.safetensors").read_bytes()


def settings(run: Path) -> dict:
    return yaml.safe_load((run / "config.yaml").read_text())


def test_it_does_what_the_recipe_and_the_command_do(
    recipe: Command, phihp: Command, place: Path
) -> None:
    agent, path = learn("pendulum", overrides=FAST, run_dir="learned")
    recipe("phihp", "task=pendulum", "run_dir=recipe", *FAST)
    phihp("train", "task=pendulum", "run_dir=command", *FAST)
    assert path == Path("learned")
    assert weights(path) == weights(place / "recipe") == weights(place / "command")
    assert settings(path) == settings(place / "recipe") == settings(place / "command")
    assert (agent.task.name, agent.metadata["samples"]) == ("pendulum", 60)
    assert agent.planner is not None
    learn("pendulum", overrides=[*FAST, "seed=1"], run_dir="other")
    assert weights(place / "other") != weights(path)


def test_names_and_overrides_may_be_given_in_any_form(place: Path) -> None:
    changes = {"model.real_steps": 30, "evaluate.episodes": 1, "planner.warm_start": True}
    words = [*FAST, *(f"{key}={str(value).lower()}" for key, value in changes.items())]
    mapping = {**flatten(FAST_MAPPING), **changes}
    runs = [
        learn("pendulum", method="ph-cem", preset="paper", overrides=given, run_dir=f"run{i}").path
        for i, given in enumerate((mapping, without_actor(words)))
    ]
    ours = settings(runs[0])
    assert (ours["method"], ours["preset"]) == ("ph-cem", "paper")
    assert (ours["planner"]["warm_start"], ours["evaluate"]["episodes"]) == (True, 1)
    assert settings(runs[1]) == ours
    assert weights(runs[0]) == weights(runs[1])


def without_actor(words):
    """Words for a method that learns no policy."""
    unfit = ("policy.", "planner.num_policy_candidates")
    return [word for word in words if not word.startswith(unfit)]


FAST_MAPPING = {
    key: yaml.safe_load(value)
    for key, value in (word.split("=", 1) for word in without_actor(FAST))
}


@pytest.mark.usefixtures("registries", "place")
def test_a_task_need_not_be_registered() -> None:
    task = replace(get_task("pendulum"), name="own-pendulum", max_steps=20)
    agent, path = learn(task, overrides=FAST, run_dir="run")
    assert "own-pendulum" in list_tasks()
    assert agent.task is task
    assert settings(path)["task"] == "own-pendulum"


def make_gym():
    return gymnasium.make("Pendulum-v1")


def make_torchrl():
    return SimulatedWorld("pendulum").make_env()


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize(
    "make_world",
    [
        pytest.param(make_gym, id="a gymnasium environment"),
        pytest.param(make_torchrl, id="a TorchRL environment"),
        pytest.param(lambda: make_torchrl, id="a function"),
        pytest.param(
            lambda: {"kind": "gymnasium", "id": "Pendulum-v1"}, id="settings with their kind"
        ),
        pytest.param(
            lambda: SimulatedWorld("pendulum", SimulatedConfig(friction={"joint": 2.0})),
            id="a world",
        ),
    ],
)
def test_a_world_may_be_anything_that_acts(make_world) -> None:
    agent, path = learn("pendulum", make_world(), overrides=FAST, run_dir="run")
    assert list(dict.fromkeys(metrics_column(path, "phase"))) == ["model", "policy", "evaluate"]
    assert metrics_column(path, "real_steps")[-1] == "60"
    assert agent.planner is not None


def test_what_settings_can_make_again_is_written_and_the_rest_is_named(
    phihp: Command, place: Path
) -> None:
    given = SimulatedWorld("pendulum", SimulatedConfig(friction={"joint": 2.0}))
    known = learn("pendulum", given, overrides=FAST, run_dir="known").path
    assert settings(known)["world"]["friction"] == {"joint": 2.0}
    phihp("train", "resume=known")
    unknown = learn("pendulum", make_torchrl, overrides=FAST, run_dir="unknown").path
    assert settings(unknown)["world"] == {"kind": "given"}
    with pytest.raises(SystemExit, match=r"error: world\.kind: .*pass that world again"):
        phihp("train", "resume=unknown")


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "td3"}, r"^method: .*simulated world, 'td3' needs one"),
        ({"method": "td-mpc-star"}, r"^method: .*simulated world, 'td-mpc-star' needs one"),
        ({"method": "cem-oracle"}, r"^model\.kind: .*'oracle'"),
        ({"task": "acrobot"}, r"^world: .*theta1"),
        ({"task": "nothing"}, r"^task: .*'nothing'"),
        ({"world": 3}, r"^world: .*3"),
        ({"world": "nothing"}, r"^world: .*'nothing'"),
        ({"method": "nothing"}, r"^method: .*'nothing'"),
        ({"overrides": ["world=gymnasium", "world.id=Pendulum-v1"]}, r"^world: .*got both"),
        ({"overrides": ["policy.updatez=1"]}, r"^policy\.updatez: "),
        ({"overrides": {"policy.updates": 0}}, r"^policy\.updates: "),
    ],
)
def test_what_does_not_fit_is_refused_before_any_step(arguments, message) -> None:
    steps = []

    def make_env():
        env = make_torchrl()
        step = env.base_env._step
        env.base_env._step = lambda data: steps.append(data) or step(data)
        return env

    words = {"task": "pendulum", "world": make_env, "run_dir": "run", **arguments}
    with pytest.raises(ConfigError, match=message):
        learn(**words)
    assert steps == []
    assert not list(Path("run").rglob("*.csv"))


@pytest.mark.usefixtures("place")
def test_a_world_may_be_among_the_words() -> None:
    words = {"world.friction": {"joint": 2.0}, "phases": ["model", "policy", "evaluate"]}
    path = learn("pendulum", overrides=[*FAST, *override_lines(words)], run_dir="run").path
    assert settings(path)["world"]["friction"] == {"joint": 2.0}


@pytest.mark.usefixtures("registries")
def test_plugins_may_be_among_the_words(place: Path) -> None:
    (place / "my_plugin.py").write_text(PLUGIN)
    words = [*FAST, "plugins=[my_plugin.py]", "rest.naps=2"]
    agent, path = learn("my-pendulum", method="rested", overrides=words, run_dir="run")
    assert agent.task.max_steps == 20
    assert metrics_column(path, "phase").count("rest") == 2


@pytest.mark.usefixtures("place")
def test_a_run_that_saves_no_agent_says_so() -> None:
    with pytest.raises(ConfigError, match=r"^phases: .*'evaluate'"):
        learn("pendulum", overrides=[*FAST, "phases=[model]"], run_dir="run")
    assert not Path("run").exists()  # it says so before the first real step


def test_it_is_where_users_look_for_it() -> None:
    assert phihp_torchrl.learn is learn
    assert Learned._fields == ("agent", "path")
    assert load_config("pendulum")["world"]["kind"] == "simulated"
