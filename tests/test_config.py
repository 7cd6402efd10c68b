"""Every recipe configuration composes, and every wrong key is named."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
from bare_keys import bare_keys
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf

from phihp_torchrl.tasks import get_task
from phihp_torchrl.trainers import ConfigError, RunConfig, from_mapping, read_request, to_mapping
from phihp_torchrl.trainers.config import differences

CONFIG = Path(__file__).parents[1] / "recipes" / "config"
TASKS = sorted(path.stem for path in (CONFIG / "task").glob("*.yaml"))
PRESETS = sorted(path.stem for path in (CONFIG / "preset").glob("*.yaml"))
LOGGERS = sorted(path.stem for path in (CONFIG / "logger").glob("*.yaml"))


def request(*overrides: str, config_dir: Path = CONFIG):
    with initialize_config_dir(str(config_dir), version_base="1.3"):
        composed = compose("phihp", list(overrides))
    return read_request(composed, overrides)


def config(*overrides: str) -> RunConfig:
    return request(*overrides).config


# ------------------------------------------------------------------------------------- composing


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


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_task_composes_with_every_preset(task: str, preset: str) -> None:
    ours = config(f"task={task}", f"preset={preset}")
    assert (ours.task, ours.preset) == (task, preset)
    assert get_task(task).name == task


@pytest.mark.parametrize("logger", LOGGERS)
def test_every_logger_composes(logger: str) -> None:
    assert config(f"logger={logger}").logger.name == logger


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_has_every_key_of_its_dataclasses(preset: str) -> None:
    given = OmegaConf.to_container(OmegaConf.load(CONFIG / "preset" / f"{preset}.yaml"))
    for method, names in (("phihp", ("model", "policy", "planner")), ("td3", ("td3",))):
        whole = to_mapping(RunConfig(task="pendulum", method=method))
        for name in names:
            assert keys(given[name]) == keys(whole[name])


def keys(mapping: Mapping[str, Any]) -> set[str]:
    nested = (keys(v) if isinstance(v, Mapping) else set() for v in mapping.values())
    pairs = zip(mapping, nested, strict=True)
    return {f"{k}.{n}" if n else k for k, names in pairs for n in ({""} | names)}


@pytest.mark.parametrize("path", sorted(CONFIG.rglob("*.yaml")), ids=lambda p: p.stem)
def test_every_key_has_a_comment_above_it(path: Path) -> None:
    assert not bare_keys(path)


def test_the_papers_tables() -> None:
    acrobot = config("task=acrobot", "preset=paper")
    assert (acrobot.model.lambda_0, acrobot.model.tau_ph) == (1e2, 1e5)
    assert acrobot.model.hidden_sizes == (16, 16, 16)
    assert (acrobot.model.collect.num_candidates, acrobot.model.collect.top_k) == (700, 20)
    assert (acrobot.planner.planning_horizon, acrobot.planner.alpha) == (4, 0.8)
    swingup = config("task=acrobot-swingup", "preset=paper")
    assert (swingup.policy.updates, swingup.model.real_steps) == (2_000_000, 15_000)
    assert swingup.policy.td3.critic_learning_rate == 1e-4
    cartpole = config("task=cartpole-swingup", "preset=paper")
    assert (cartpole.planner.planning_horizon, cartpole.planner.alpha) == (6, 0.03)


@pytest.mark.parametrize(("preset", "real_steps"), [("default", 1000), ("paper", 2000)])
def test_the_command_line_beats_the_task_and_the_task_the_preset(
    preset: str, real_steps: int
) -> None:
    assert config("task=pendulum", f"preset={preset}").model.real_steps == real_steps
    changed = config("task=pendulum", f"preset={preset}", "model.real_steps=300")
    assert changed.model.real_steps == 300


def test_a_configuration_survives_yaml() -> None:
    ours = config("task=acrobot", "preset=paper", "logger=wandb")
    text = OmegaConf.to_yaml(OmegaConf.create(to_mapping(ours)))
    assert from_mapping(RunConfig, OmegaConf.to_container(OmegaConf.create(text))) == ours


def test_a_task_of_ones_own_is_one_python_file_and_one_yaml(tmp_path: Path) -> None:
    (tmp_path / "my_task.py").write_text(
        "from dataclasses import replace\n"
        "from phihp_torchrl import get_task, register_task\n"
        "register_task(replace(get_task('pendulum'), name='my-task', max_steps=30))\n"
    )
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "my-task.yaml").write_text(
        "# @package _global_\ntask: my-task\npresets:\n  default:\n    planner:\n      alpha: 0.7\n"
    )
    overrides = [f"hydra.searchpath=[file://{tmp_path}]", "task=my-task"]
    plugin = f"plugins=[{tmp_path / 'my_task.py'}]"
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        composed = compose("phihp", [*overrides, plugin])
    for _ in range(2):  # the file is imported once
        ours = read_request(composed, ["task=my-task", plugin]).config
    assert (ours.task, ours.planner.alpha) == ("my-task", 0.7)
    assert get_task("my-task").max_steps == 30


# ------------------------------------------------------------------------------------- refusing


@pytest.fixture(scope="module")
def composed():
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        return compose("phihp")


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("policy.updatez=3", "policy.updatez"),
        ("task=nonsense", "task/nonsense"),
        ("preset=nonsense", "preset/nonsense"),
        ("method=nonsense", "method/nonsense"),
        ("logger=nonsense", "logger/nonsense"),
        ("resume=no_such_run", "no_such_run"),
        ("resume=3", "resume"),
        ("run_dir=3", "run_dir"),
    ],
)
def test_what_composes_wrongly_is_named(override: str, named: str) -> None:
    with pytest.raises((ConfigError, HydraException), match=named):
        config(override)


@pytest.mark.parametrize(
    ("override", "named"),
    [
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
        ("evaluate.episodes=0", "evaluate.episodes"),
        ("plugins=[no_such_module]", "no_such_module"),
        ("plugins=[no_such_file.py]", "no_such_file"),
    ],
)
def test_what_is_wrong_is_named(composed, override: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        read_request(composed, [override])


def test_a_task_section_with_an_unknown_key_is_refused(tmp_path: Path) -> None:
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "odd.yaml").write_text(
        "# @package _global_\ntask: pendulum\npresets:\n  default:\n    planner:\n      alfa: 0.7\n"
    )
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        composed = compose("phihp", [f"hydra.searchpath=[file://{tmp_path}]", "task=odd"])
    with pytest.raises(ConfigError, match=r"planner\.alfa"):
        read_request(composed, [])


def test_an_unregistered_task_is_refused(tmp_path: Path) -> None:
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "odd.yaml").write_text("# @package _global_\ntask: unheard-of\n")
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        composed = compose("phihp", [f"hydra.searchpath=[file://{tmp_path}]", "task=odd"])
    with pytest.raises(ConfigError, match=r"unheard-of.*plugin"):
        read_request(composed, [])


# ------------------------------------------------------------------------------------- converting


@dataclass(frozen=True)
class Inner:
    rate: float = 0.1
    pair: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Outer:
    name: Literal["a", "b"]
    inner: Inner = field(default_factory=Inner)
    size: int | None = None
    table: Mapping[str, float] = field(default_factory=dict)
    source: str | None = field(default=None, metadata={"key": "from"})

    def __post_init__(self) -> None:
        if self.size == 0:
            raise ValueError("size: expected a positive number, got 0.")


def test_a_mapping_becomes_dataclasses_and_back() -> None:
    mapping = {
        "name": "a",
        "inner": {"rate": 1.0, "pair": [1.0, 2.0]},
        "size": 3,
        "table": {"g": 9.8},
        "from": "here",
    }
    outer = from_mapping(Outer, mapping)
    assert outer == Outer("a", Inner(1.0, (1.0, 2.0)), 3, {"g": 9.8}, "here")
    assert to_mapping(outer) == mapping


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        ({}, "x.name: missing"),
        ({"name": "c"}, "x.name: expected one of"),
        ({"name": "a", "nane": 1}, "x.nane: unknown key; did you mean 'name'"),
        ({"name": "a", "zzz": 1}, "x.zzz: unknown key; expected one of"),
        ({"name": "a", "inner": {"rate": "fast"}}, "x.inner.rate: expected a number"),
        ({"name": "a", "inner": {"rate": True}}, "x.inner.rate: expected a number"),
        ({"name": "a", "inner": {"pair": [1]}}, "x.inner.pair: expected 2 values"),
        ({"name": "a", "inner": 3}, "x.inner: expected keys and values"),
        ({"name": "a", "size": 0}, "x.size: expected a positive number"),
        ({"name": "a", "size": 1.5}, "x.size: expected a whole number"),
        ({"name": "a", "table": {"g": "x"}}, "x.table.g: expected a number"),
        (None, "x: expected keys and values"),
    ],
)
def test_conversion_names_the_key(mapping: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        from_mapping(Outer, mapping, "x")


def test_differences_are_named() -> None:
    ours = {"a": {"b": 1, "c": 2}, "d": 3}
    assert differences(ours, ours) == []
    assert differences(ours, {"a": {"b": 1, "c": 4}, "e": 5}) == [
        "a.c: 2, not 4",
        "d: 3, not None",
        "e: None, not 5",
    ]


def test_fast_budget_goes_over_preset_and_task() -> None:
    fast, own = (config("task=acrobot", *more).planner for more in (["budget=fast"], []))
    assert fast.num_candidates * fast.optim_steps < own.num_candidates * own.optim_steps
    assert fast.planning_horizon < own.planning_horizon
    assert fast.alpha == own.alpha
