"""Every configuration composes and reads, layers go over one another, and wrong keys are named."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import OmegaConf

import phihp_torchrl.tdmpc  # noqa: F401  (it registers its phase)
from phihp_torchrl import load_config
from phihp_torchrl.config import (
    METHODS,
    YAML,
    ConfigError,
    apply_overrides,
    compose_yaml,
    offer,
    override_lines,
    parse_overrides,
)
from phihp_torchrl.tasks import get_task
from phihp_torchrl.trainers import RunConfig, read_request, read_run_config, run

TASKS = sorted(path.stem for path in (YAML / "task").glob("*.yaml"))
PRESETS = sorted(path.stem for path in (YAML / "preset").glob("*.yaml"))


def config(*overrides: str, **names: Any) -> RunConfig:
    return read_run_config(load_config(overrides=overrides, **names))


# Composing


def test_the_six_tasks_and_the_published_variant_have_a_file() -> None:
    assert TASKS == [
        "acrobot",
        "acrobot-swingup",
        "cartpole",
        "cartpole-swingup",
        "cartpole-swingup-published",
        "pendulum",
        "pendulum-swingup",
    ]
    assert PRESETS == ["default", "paper"]


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_task_composes_with_every_preset(task: str, preset: str) -> None:
    ours = config(task=task, preset=preset)
    assert (ours.task, ours.preset) == (task, preset)
    assert get_task(task).name == task


@pytest.mark.parametrize("method", METHODS)
def test_every_method_composes(method: str) -> None:
    check_method(config(method=method), method)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_method_composes_with_every_preset(method: str, preset: str) -> None:
    """With two of the tasks each, so that every task meets methods of every kind."""
    first = list(METHODS).index(method) + PRESETS.index(preset)
    for task in (TASKS[first % len(TASKS)], TASKS[(first + 3) % len(TASKS)]):
        ours = config(task=task, preset=preset, method=method)
        assert (ours.task, ours.preset) == (task, preset)
        check_method(ours, method)


def check_method(ours: RunConfig, name: str) -> None:
    """The run is of the method, with the sections it needs and no others."""
    method = METHODS[name]
    assert ours.method == name
    phases = [name for name in method.phases if ours.preset == "default" or name != "calibrate"]
    assert ours.phases_to_do == tuple(phases)
    assert tuple(ours.sections) == method.phases
    assert (ours.planner is not None) == method.plans
    if method.model_kind is not None:
        assert ours.section("model").kind == method.model_kind


@pytest.mark.parametrize("logger", ["csv", "wandb", "tensorboard"])
def test_every_logger_composes(logger: str) -> None:
    assert config(f"logger={logger}").logger.name == logger


@pytest.mark.parametrize("planner", ["cem", "mppi"])
def test_every_planner_composes(planner: str) -> None:
    ours = config(f"planner={planner}").planner
    assert ours is not None
    assert ours.kind == planner


@pytest.mark.parametrize(
    "words",
    [
        ["world=simulated"],
        ["world=gymnasium", "world.id=Pendulum-v1"],
        ["world=torchrl", "world.make=my_module:make"],
    ],
)
def test_every_world_composes(words: list[str]) -> None:
    assert config(*words).world.kind == words[0].removeprefix("world=")


def test_a_world_that_lacks_a_setting_names_it() -> None:
    with pytest.raises(ConfigError, match=r"^world\.id: missing: expected id=\.\.\.; "):
        config("world=gymnasium")


def test_the_papers_tables() -> None:
    acrobot = config(task="acrobot", preset="paper")
    model = acrobot.section("model")
    assert (model.lambda_0, model.tau_ph) == (1e2, 1e5)
    assert model.hidden_sizes == (16, 16, 16)
    assert (model.collect.num_candidates, model.collect.top_k) == (700, 20)
    assert acrobot.planner is not None
    assert (acrobot.planner.planning_horizon, acrobot.planner.alpha) == (4, 0.8)
    swingup = config(task="acrobot-swingup", preset="paper")
    assert swingup.section("policy").updates == 2_000_000
    assert swingup.section("model").real_steps == 15_000
    assert swingup.section("policy").td3.critic_learning_rate == 1e-4
    cartpole = config(task="cartpole-swingup", preset="paper")
    assert cartpole.planner is not None
    assert (cartpole.planner.planning_horizon, cartpole.planner.alpha) == (6, 0.03)


# Layers


@pytest.mark.parametrize(("preset", "real_steps"), [("default", 1000), ("paper", 2000)])
def test_the_command_line_beats_the_task_and_the_task_the_preset(
    preset: str, real_steps: int
) -> None:
    assert config(task="pendulum", preset=preset).section("model").real_steps == real_steps
    changed = config("model.real_steps=300", task="pendulum", preset=preset)
    assert changed.section("model").real_steps == 300


def test_the_command_line_beats_the_method() -> None:
    assert config(method="ph-cem").planner.planning_horizon == 30
    assert config("planner.planning_horizon=7", method="ph-cem").planner.planning_horizon == 7


def test_fast_budget_goes_over_preset_and_task() -> None:
    fast, own = (config(*more, task="acrobot").planner for more in (["budget=fast"], []))
    work = [s.num_candidates * s.optim_steps * s.planning_horizon for s in (fast, own)]
    assert work[0] < work[1] / 10
    assert fast.alpha == own.alpha


def test_a_layer_of_another_planners_numbers_is_left_out() -> None:
    mppi = load_config("pendulum-swingup", overrides=["planner=mppi"])["planner"]
    assert mppi["kind"] == "mppi"
    assert mppi["num_candidates"] == 134
    for more in ({"preset": "paper"}, {"overrides": ["planner=mppi", "budget=fast"]}):
        words = {"overrides": ["planner=mppi"], **more}
        assert load_config("acrobot", **words)["planner"] == mppi


@pytest.mark.parametrize("words", [{}, {"logger": "wandb"}, {"planner": "mppi"}])
def test_a_configuration_survives_yaml(words: Mapping[str, str]) -> None:
    ours = read_run_config(load_config("acrobot", preset="paper", overrides=words))
    text = OmegaConf.to_yaml(OmegaConf.create(ours.to_mapping()))
    assert read_run_config(OmegaConf.to_container(OmegaConf.create(text))) == ours


def test_names_may_be_words_or_arguments() -> None:
    settings = load_config("acrobot", method="ph-cem", preset="paper")
    assert settings == load_config(overrides=["task=acrobot", "method=ph-cem", "preset=paper"])
    assert load_config() == load_config("pendulum-swingup", method="phihp", preset="default")


# Overrides


def test_a_composition_that_is_kept_is_no_other_ones() -> None:
    """What is composed once in a process is not what somebody did to it, nor what was offered."""
    before = load_config("pendulum")
    changed = load_config("pendulum", overrides=["policy.updates=7", "+new.key=[1]"])
    changed["planner"]["alpha"] = changed["policy"] = None
    assert load_config("pendulum") == before
    composed = compose_yaml(["task=pendulum"])
    updates, composed.policy.updates = composed.policy.updates, 9
    assert compose_yaml(["task=pendulum"]).policy.updates == updates
    for number in (1, 2):
        offer("task", "kept-task", {"task": "kept-task", "seed": number})
        assert load_config("kept-task")["seed"] == number


def test_overrides_may_be_a_mapping() -> None:
    changes = {
        "policy.updates": 10,
        "model.hidden_sizes": [8, 8],
        "model.fit.batch_size": None,
        "model.warm_start": False,
        "world.friction": {"joint": 0.25},
        "seed": 3,
    }
    words = [
        "policy.updates=10",
        "model.hidden_sizes=[8,8]",
        "model.fit.batch_size=null",
        "model.warm_start=false",
        "world.friction={joint:0.25}",
        "seed=3",
    ]
    settings = load_config("pendulum", overrides=changes)
    assert settings == load_config("pendulum", overrides=words)
    ours = read_run_config(settings)
    assert (ours.section("policy").updates, ours.section("model").hidden_sizes) == (10, (8, 8))
    assert ours.section("model").fit.batch_size is None
    assert (ours.world.friction, ours.seed) == ({"joint": 0.25}, 3)
    with pytest.raises(ConfigError, match=r"^overrides: expected a list of texts or a mapping"):
        load_config("pendulum", overrides="seed=3")


texts = st.text(st.characters(exclude_categories=["C"]))
scalars = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | texts
option_keys = st.from_regex(r"[a-z][a-z_]{0,5}", fullmatch=True).filter(
    lambda key: key not in ("null", "true", "false", "inf", "nan")
)
values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(option_keys, inner, max_size=3),
    max_leaves=6,
)


@given(values)
@example(["True", "null", "NULL", "-inf", "nan", "1e3", "-3", ".5", "3d", "+1", "a:", "a."])
@example({"a": "b:c", "path": "/tmp/x", "file": "file:///tmp/x y", "none": None})
@example(["é", "it's", 'say "so"', "a\\", "a\\b", "a\\'", "\\", "", " ", "???", "[1]", "{a:1}"])
def test_any_value_of_a_mapping_is_read_as_what_it_was(value: Any) -> None:
    (line,) = parse_overrides(override_lines({"some.key": value}))
    assert line.key_or_group == "some.key"
    assert repr(line.value()) == repr(value)


def test_overrides_go_over_a_mapping_and_leave_it_alone() -> None:
    settings = {"policy": {"updates": 8000, "td3": {"gamma": 0.9}}, "task": "pendulum"}
    changed = apply_overrides(settings, ["policy.updates=10", "+new.key=1", "task=acrobot"])
    assert changed == {
        "policy": {"updates": 10, "td3": {"gamma": 0.9}},
        "task": "acrobot",
        "new": {"key": 1},
    }
    assert settings["policy"]["updates"] == 8000
    with pytest.raises(ConfigError, match=r"^settings: .*no_assignment"):
        apply_overrides(settings, ["no_assignment"])


# A task of one's own


def write_task(path: Path, name: str, text: str) -> Path:
    (path / "task").mkdir()
    (path / "task" / f"{name}.yaml").write_text(f"# @package _global_\n{text}")
    return path


def test_a_task_of_ones_own_is_one_python_file_and_one_yaml(tmp_path: Path) -> None:
    (tmp_path / "my_task.py").write_text(
        "from dataclasses import replace\n"
        "from phihp_torchrl import get_task, register_task\n"
        "register_task(replace(get_task('pendulum'), name='my-task', max_steps=30))\n"
    )
    text = "task: my-task\npresets:\n  default:\n    planner:\n      alpha: 0.7\n"
    write_task(tmp_path, "my-task", text)
    words = ["task=my-task", f"plugins=[{tmp_path / 'my_task.py'}]"]
    composed = compose_yaml(words, tmp_path)
    for _ in range(2):  # the file is imported once
        ours = read_request(composed, words).config
    assert (ours.task, ours.planner.alpha) == ("my-task", 0.7)
    assert get_task("my-task").max_steps == 30
    assert load_config(overrides=words, config_dir=tmp_path)["planner"]["alpha"] == 0.7


def test_a_task_that_is_registered_needs_no_yaml() -> None:
    offer("task", "bare-task", {"task": "bare-task"})
    settings, preset = load_config("bare-task"), load_config("pendulum-swingup")
    assert settings["task"] == "bare-task"
    assert settings["logger"] == preset["logger"]
    assert settings["policy"]["updates"] == 8000  # the preset's own


# Refusing


@pytest.fixture(scope="module")
def composed() -> Any:
    return compose_yaml([])


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("policy.updatez=3", "policy.updatez: unknown key; did you mean 'policy.updates'?"),
        (
            "policy.td3.gamma_seconds=2",
            "policy.td3.gamma_seconds: unknown key; did you mean 'policy.td3.gamma'?",
        ),
        ("policy.gamma=0.9", "policy.gamma: unknown key; did you mean 'policy.td3.gamma'?"),
        ("evaluate.seed=3", "evaluate.seed: unknown key; did you mean 'evaluate.first_seed'?"),
        (
            "planner.horizon_seconds=1",
            "planner.horizon_seconds: unknown key; did you mean 'planner.planning_horizon'?",
        ),
        (
            "gamma_seconds=2",  # of no section, and of none that another method reads
            "gamma_seconds: unknown key; did you mean 'planner.gamma' or 'policy.td3.gamma'?",
        ),
        (
            "policy.mx_seconds=1",
            "policy.mx_seconds: unknown key; did you mean 'policy.max_seconds'?",
        ),
        ("policy.seed=3", "policy.seed: unknown key; did you mean 'seed'?"),
        ("encoder_dim=3", "encoder_dim: unknown key; did you mean 'tdmpc.learn.told.encoder_dim'?"),
        ("qqqqqq.z=3", "qqqqqq.z: unknown key;"),
        ("task=nonsense", "task: expected one of ['acrobot', "),
        ("preset=nonsense", "preset: expected one of ['default', 'paper'], got 'nonsense'."),
        ("method=nonsense", "method: expected one of ['cem-oracle', "),
        ("logger=nonsense", "logger: expected one of ['csv', 'tensorboard', 'wandb'], got"),
        ("world=nonsense", "world: expected one of ['given', 'gymnasium', 'recorded', "),
        ("planner=nonsense", "planner: expected one of ['cem', 'mppi'], got 'nonsense'."),
        ("budget=nonsense", "budget: expected one of ['fast', 'full'], got 'nonsense'."),
        ("seed=[1", "settings: "),
    ],
)
def test_what_composes_wrongly_is_named(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        load_config(overrides=[override])


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("resume=no_such_run", "no_such_run"),
        ("resume=3", "resume"),
        ("run_dir=3", "run_dir"),
        ("+policy.updatez=3", "policy.updatez"),
        ("+policy.td3.gama=0.9", "policy.td3.gama"),
        ("seed=-1", "seed"),
        ("seed=1000000", "seed"),
        ("seed=one", "seed"),
        ("seed=1.5", "seed"),
        ("phases=[policy]", "from"),
        ("phases=[model,evaluate]", "phases"),
        ("phases=[]", "phases"),
        ("phases=[modell]", "phases"),
        ("phases=model", "phases"),
        ("from=somewhere", "from"),
        ("threads=0", "threads"),
        ("checkpoint_interval=-1", "checkpoint_interval"),
        ("model.real_steps=0", "model.real_steps"),
        ("model.real_steps=null", "model.real_steps"),
        ("model.kind=magic", "model.kind"),
        ("model.hidden_sizes=16", "model.hidden_sizes"),
        ("model.hidden_sizes=[16,a]", r"model.hidden_sizes\[1\]"),
        ("model.fit.method=magic", "model.fit.method"),
        ("policy.td3.gamma=1.5", "policy.td3.gamma"),
        ("policy.max_seconds=soon", "policy.max_seconds"),
        ("policy=3", "policy"),
        ("planner.top_k=1000", "planner.top_k"),
        ("planner.planning_horizon=0", "planner.planning_horizon"),
        ("planner.warm_start=3", "planner.warm_start"),
        ("planner.kind=magic", "planner.kind"),
        ("world.kind=magic", "world.kind"),
        ("world.integrator=euler", "world.integrator"),
        ("world.substeps=0", "world.substeps"),
        ("world.friction=3", "world.friction"),
        ("evaluate.episodes=0", "evaluate.episodes"),
        ("+sections.policy=3", "sections"),
        ("tdmpc.horizon=3", "tdmpc.horizon"),
        ("plugins=[no_such_module]", "no_such_module"),
        ("plugins=[no_such_file.py]", "no_such_file"),
    ],
)
def test_what_is_wrong_is_named(composed: Any, override: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        read_request(composed, [override])


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("task: pendulum\npresets:\n  default:\n    planner:\n      alfa: 0.7\n", "planner.alfa"),
        ("task: pendulum\nchanges:\n  polici:\n    updates: 1\n", "changes.polici"),
    ],
)
def test_a_task_section_with_an_unknown_key_is_refused(
    tmp_path: Path, text: str, named: str
) -> None:
    with pytest.raises(ConfigError, match=named):
        load_config("odd", config_dir=write_task(tmp_path, "odd", text))


def test_an_unregistered_task_is_refused(tmp_path: Path) -> None:
    write_task(tmp_path, "odd", "task: unheard-of\n")
    ours = read_request(compose_yaml(["task=odd"], tmp_path), []).config
    with pytest.raises(ConfigError, match=r"^task: expected one of .*unheard-of.*plugin"):
        run(ours, tmp_path / "run")
    assert not (tmp_path / "run").exists()
