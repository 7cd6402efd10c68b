"""The methods: what each is made of, and that each runs, resumes and is refused where it must."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from test_real_td3 import SMALL as REAL
from test_run import CONFIG as SMALL
from test_run import Crash, assert_equal, rows

from phihp_torchrl.agents.tdmpc import TDMPCConfig, TOLDConfig
from phihp_torchrl.deployment import load_agent
from phihp_torchrl.planners.factory import MPPIConfig
from phihp_torchrl.systems import Pendulum, System
from phihp_torchrl.tasks import get_task, list_tasks, register_task, registry
from phihp_torchrl.trainers import (
    METHODS,
    ConfigError,
    Method,
    RunConfig,
    TDMPCTrainConfig,
    from_mapping,
    get_method,
    read_request,
    read_result,
    register_method,
    run,
    to_mapping,
)
from phihp_torchrl.trainers.checkpoints import load_state

run_module = import_module("phihp_torchrl.trainers.run")

RECIPES = Path(__file__).parents[1] / "recipes"
CONFIG = RECIPES / "config"
TDMPC = TDMPCTrainConfig(
    real_steps=50,
    seed_steps=25,
    updates_per_step=0.2,
    horizon=3,
    batch_size=4,
    replay_capacity=60,
    evaluation_interval=30,
    evaluation_episodes=2,
    learn=TDMPCConfig(told=TOLDConfig(latent_dim=4, encoder_dim=8, mlp_dim=8)),
    planner=MPPIConfig(
        planning_horizon=2,
        optim_steps=1,
        num_candidates=8,
        top_k=2,
        num_policy_candidates=2,
        schedule_steps=40,
    ),
)
TASKS = sorted(path.stem for path in (CONFIG / "task").glob("*.yaml"))


def config(*overrides: str, recipe: str = "phihp") -> RunConfig:
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        composed = compose(recipe, list(overrides))
    return read_request(composed, overrides).config


def small(method: str, task: str = SMALL.task) -> RunConfig:
    """The smallest run of a method."""
    chosen = get_method(method)
    model = SMALL.model
    if chosen.model_kind is not None:
        oracle = chosen.model_kind == "oracle"
        model = replace(model, kind=chosen.model_kind, real_steps=0 if oracle else 60)
    planner = SMALL.planner
    if chosen.acting == "plain_planner":
        planner = replace(planner, num_policy_candidates=0, replan_every=2)
    return replace(
        SMALL,
        task=task,
        method=method,
        phases=None,
        model=model,
        td3=REAL,
        tdmpc=TDMPC,
        planner=planner,
    )


# ------------------------------------------------------------------------------------- composing


def test_every_method_has_a_file() -> None:
    assert sorted(path.stem for path in (CONFIG / "method").glob("*.yaml")) == sorted(METHODS)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_every_method_composes_on_every_task(method: str, preset: str) -> None:
    for task in TASKS:
        ours = config(f"method={method}", f"task={task}", f"preset={preset}")
        chosen = get_method(method)
        assert (ours.method, ours.phases) == (method, chosen.phases)
        for section in ("model", "policy", "td3", "tdmpc", "planner"):
            assert (getattr(ours, section) is not None) == (section in chosen.sections)
        assert from_mapping(RunConfig, to_mapping(ours)) == ours


def test_the_settings_of_cem_oracle_are_the_papers() -> None:
    for task in TASKS:
        ours = config(f"task={task}", recipe="cem")
        assert (ours.method, ours.model.kind, ours.model.real_steps) == ("cem-oracle", "oracle", 0)
        plan = ours.planner
        assert (plan.num_candidates, plan.top_k, plan.optim_steps) == (700, 20, 3)
        assert (plan.planning_horizon, plan.replan_every) == (30, 5)


def test_the_settings_of_tdmpc_are_the_papers() -> None:
    """The paper's table; 537 candidates are 512 at random and 25 of the policy."""
    for task in TASKS:
        ours = config(f"task={task}", recipe="tdmpc")
        assert (ours.method, ours.preset) == ("td-mpc", "paper")
        section, plan = ours.tdmpc, ours.tdmpc.planner
        rate = 1e-4 if task in ("cartpole", "acrobot") else 1e-3
        assert (section.learn.learning_rate, section.learn.critic_learning_rate) == (1e-3, rate)
        assert (section.batch_size, section.learn.told.mlp_dim) == (512, 512)
        assert (section.learn.tau, section.learn.target_interval) == (0.01, 2)
        assert (section.seed_steps, section.replay_capacity) == (5000, 10**6)
        assert (section.priority_alpha, section.priority_beta) == (0.6, 0.4)
        assert (plan.num_candidates, plan.num_policy_candidates, plan.top_k) == (537, 25, 64)
        assert (plan.optim_steps, plan.planning_horizon, section.horizon) == (6, 5, 5)
        default = config(f"task={task}", "preset=default", recipe="tdmpc").tdmpc
        assert default.learn.critic_learning_rate == rate


def test_the_command_line_beats_the_method_and_the_method_the_task() -> None:
    ours = config("method=ph-cem", "task=acrobot", "planner.top_k=7")
    assert (ours.planner.top_k, ours.planner.num_candidates) == (7, 700)
    assert ours.model.hidden_sizes == (16, 16, 16)  # the task's, which the method leaves alone


def test_a_method_of_ones_own_is_one_python_file_and_one_yaml(tmp_path: Path) -> None:
    """The example of the docs."""
    blocks = (RECIPES.parent / "docs" / "methods" / "index.md").read_text().split("```")
    python, yaml = (
        next(block for block in blocks if block.startswith(kind)).split("\n", 1)[1]
        for kind in ("python", "yaml")
    )
    plugin = tmp_path / "my_method.py"
    plugin.write_text(python)
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "prior-cem.yaml").write_text(yaml)
    overrides = ["method=prior-cem", f"plugins=[{plugin}]"]
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        composed = compose("phihp", [f"hydra.searchpath=[file://{tmp_path}]", *overrides])
    try:
        ours = read_request(composed, overrides).config
        assert (ours.phases, ours.model.kind) == (("model", "evaluate"), "prior")
        assert ours.policy is None
    finally:
        METHODS.pop("prior-cem", None)


# ------------------------------------------------------------------------------------- running

PARTS = {
    "hybrid_planner": {"planner", "actor"},
    "plain_planner": {"planner"},
    "actor": {"actor"},
    "own_planner": {"planner", "actor"},
}


@pytest.fixture(scope="module")
def wholes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run of every method that nothing disturbed."""
    paths = {name: tmp_path_factory.mktemp("runs") / name for name in METHODS}
    for name, path in paths.items():
        assert run(small(name), path).finished
    return paths


@pytest.mark.parametrize("method", METHODS)
def test_a_run_evaluates_and_saves_what_the_method_acts_with(
    wholes: dict[str, Path], method: str
) -> None:
    path, chosen = wholes[method], get_method(method)
    results = json.loads((path / "evaluation.json").read_text())
    assert results.keys() == PARTS[chosen.acting]
    agent = load_agent(path / "agent")
    assert (agent.planner is not None) == ("planner" in PARTS[chosen.acting])
    assert (agent.actor is not None) == (chosen.acting != "plain_planner")
    steps = json.loads((path / "metadata.json").read_text())["real_steps"]
    expected = [small(method).model, small(method).td3, small(method).tdmpc]
    assert agent.metadata["samples"] == steps
    assert steps == sum(part.real_steps for part in expected if part is not None)
    result = read_result(path)
    assert (result.label, result.samples) == (chosen.label, steps)


@pytest.mark.parametrize("method", METHODS)
def test_a_run_that_crashed_goes_on_to_the_same_end(
    wholes: dict[str, Path], tmp_path: Path, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    units = len(rows(wholes[method]))
    log_unit = run_module._Run._log_unit

    def crash(self: Any, *arguments: Any) -> None:
        log_unit(self, *arguments)
        if self.position.unit in (units // 2, units - 1) and self.position.unit not in crashed:
            crashed.add(self.position.unit)
            raise Crash

    crashed: set[int] = set()
    monkeypatch.setattr(run_module._Run, "_log_unit", crash)
    with pytest.raises(Crash):
        run(small(method), tmp_path / "run")
    for _ in range(3):
        torch.rand(3)
        try:
            finished = run(small(method), tmp_path / "run", resume=True).finished
            break
        except Crash:
            continue
    assert finished
    assert rows(tmp_path / "run") == rows(wholes[method])
    for phase in get_method(method).phases:
        states = [
            load_state(path / "phases" / phase, metadata={"task": SMALL.task})
            for path in (tmp_path / "run", wholes[method])
        ]
        assert_equal(*states, phase)


def test_a_method_may_go_on_from_the_phases_of_another(
    wholes: dict[str, Path], tmp_path: Path
) -> None:
    """The actor of TD3-im-ph is that of PhIHP, so one training serves both."""
    later = replace(small("td3-im-ph"), phases=("evaluate",), start_from=str(wholes["phihp"]))
    assert run(later, tmp_path / "run").finished
    ours, theirs = (
        json.loads((path / "evaluation.json").read_text())["actor"]["returns"]
        for path in (tmp_path / "run", wholes["phihp"])
    )
    assert ours == theirs
    assert json.loads((tmp_path / "run" / "metadata.json").read_text())["real_steps"] == 60


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_starts_and_steps_on_every_task(tmp_path: Path, method: str) -> None:
    for name in TASKS:
        brief = f"brief-{name}"
        if brief not in list_tasks():
            register_task(replace(get_task(name), name=brief, max_steps=20))
        result = run(small(method, brief), tmp_path / name)
        assert result.finished
        with (tmp_path / name / "metrics.csv").open(newline="") as file:
            phases = [row["phase"] for row in csv.DictReader(file)]
        assert phases[-1] == "evaluate"
        for part in PARTS[get_method(method).acting]:
            assert abs(result.metrics[f"evaluate/{part}/return_mean"]) < 500


# ------------------------------------------------------------------------------------- older runs


def test_a_run_from_before_there_were_methods_is_phihps(
    wholes: dict[str, Path], tmp_path: Path
) -> None:
    older = tmp_path / "older"
    run(replace(SMALL, phases=("model",)), older)
    content = OmegaConf.load(older / "config.yaml")
    content.pop("method")
    OmegaConf.save(content, older / "config.yaml")
    assert run(replace(SMALL, phases=("model",)), older, resume=True).finished
    later = replace(SMALL, phases=("policy",), start_from=str(older))
    assert run(later, tmp_path / "later").finished


# ------------------------------------------------------------------------------------- refusing


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+method=phip"], r"method: expected one of .*; did you mean 'phihp'\?"),
        (["method=ph-cem", "policy.updates=3"], r"policy\.updates: method 'ph-cem' has no use"),
        (["method=td3-im-ph", "planner.top_k=3"], r"planner\.top_k: method 'td3-im-ph' has no use"),
        (["method=ph-cem", "phases=[policy]"], r"phases: expected .*\['model', 'evaluate'\]"),
        (["method=dd-cem", "model.kind=hybrid"], r"model\.kind: expected 'data_driven'"),
        (
            ["method=ph-cem", "planner.num_policy_candidates=3"],
            r"num_policy_candidates: expected 0",
        ),
        (
            ["method=cem-oracle", "model.real_steps=-1"],
            r"real_steps: expected a number >= 0",
        ),
        (["method=ph-cem", "model.real_steps=0"], r"real_steps: expected a number >= 1"),
    ],
)
def test_what_does_not_fit_the_method_is_named(overrides: list[str], message: str) -> None:
    method = [o for o in overrides if o.startswith("method=")]
    with initialize_config_dir(str(CONFIG), version_base="1.3"):
        composed = compose("phihp", method)
    with pytest.raises(ConfigError, match=message):
        read_request(composed, [o.removeprefix("+") for o in overrides])


class Spring(Pendulum):
    """A pendulum whose equations are not to be known."""

    prior = System.prior

    def derivative(self, state, action):
        return torch.stack([state[..., 1], action[..., 0] - state[..., 0]], -1)


@pytest.fixture
def spring(monkeypatch: pytest.MonkeyPatch) -> None:
    """A registered task without a prior, for one test."""
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    register_task(replace(get_task("pendulum"), name="spring", system=Spring(), max_steps=20))


@pytest.mark.usefixtures("spring")
@pytest.mark.parametrize("method", METHODS)
def test_a_method_that_needs_a_prior_refuses_a_task_without_one(
    tmp_path: Path, method: str
) -> None:
    ours = small(method, "spring")
    if ours.model is not None and ours.model.kind == "hybrid":
        with pytest.raises(ConfigError, match=r"model\.kind: .*needs a prior, .*'spring', Spring"):
            run(ours, tmp_path / "run")
        assert not (tmp_path / "run").exists()
    else:
        assert run(ours, tmp_path / "run").finished


def test_a_system_needs_a_prior_or_a_derivative() -> None:
    class Nothing(System):
        state_names = ("x",)
        action_names = ("force",)

    with pytest.raises(TypeError, match="Nothing: expected a method `prior` or `derivative`"):
        Nothing()


def test_a_method_of_ones_own_needs_known_phases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(METHODS, "mine", Method("Mine", ("model", "dream", "evaluate")))
    with pytest.raises(ConfigError, match=r"'mine' has \['dream'\]"):
        run(replace(SMALL, method="mine", phases=None), tmp_path / "run")
    assert not (tmp_path / "run").exists()
    with pytest.raises(ValueError, match="'mine' is registered already"):
        register_method("mine", METHODS["mine"])
    with pytest.raises(ValueError, match="acting: expected one of"):
        Method("Mine", ("model",), acting="guess")
