"""A packaged plan is taken if it is the user's own or asked for, and is what it claims to be."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from phihp_torchrl import Agent, HybridDynamics, get_task, load_agent, save_agent
from phihp_torchrl.agents import Actor, TwinQ
from phihp_torchrl.config import STATE_VARIABLE
from phihp_torchrl.deployment import AgentError, package, place_package
from phihp_torchrl.planners import CEMConfig

CONFIG = CEMConfig(
    planning_horizon=2,
    optim_steps=2,
    num_candidates=8,
    top_k=3,
    num_policy_candidates=2,
    warm_start=True,
)

# For what takes a minute to compile: a plan of more steps goes the same way.
SMALLEST = replace(CONFIG, planning_horizon=1, optim_steps=1, warm_start=False)


def make(**changes):
    torch.manual_seed(0)
    task = get_task("pendulum")
    parts = {"actor": Actor(task, (8,)), "qvalue": TwinQ(task, (8,)), "planner_config": CONFIG}
    return Agent(task, **{"dynamics": HybridDynamics.hybrid(task), **parts, **changes})


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """An agent with a package, which is a text here, and the exported program that it stands for.

    Exporting takes seconds, so it is done once.
    """
    programs, directory = {}, tmp_path_factory.mktemp("saved")

    def compile_and_package(program, *, package_path, inductor_configs):
        Path(package_path).write_text("a package")
        programs["a package"] = program.module()

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(STATE_VARIABLE, str(tmp_path_factory.mktemp("user")))
        patch.setattr(torch._inductor, "aoti_compile_and_package", compile_and_package)
        save_agent(make(), directory, packaged=True)
        yield directory, programs["a package"]


@pytest.fixture
def directory(saved, tmp_path, monkeypatch):
    monkeypatch.setattr(torch._inductor, "aoti_load_package", lambda path: loaded(saved[1]))
    return Path(shutil.copytree(saved[0], tmp_path / "agent"))


def loaded(program):
    """A package that calls this program, as AOTInductor's loader has it."""
    return SimpleNamespace(loader=SimpleNamespace(boxed_run=lambda given: list(program(*given))))


def seen(agent, seed=0):
    torch.manual_seed(seed)
    state = agent.task.reset.sample([])
    return TensorDict(observation=agent.task.observe(state), is_init=torch.tensor([True]))


def act(agent, seed=1):
    agent.reset()
    data = seen(agent)
    torch.manual_seed(seed)
    return agent(data)["action"]


def ours(caplog):
    return [r.getMessage() for r in caplog.records if r.name.startswith("phihp_torchrl")]


def test_a_packaged_plan_is_the_eager_one(directory, caplog):
    eager, packaged = (load_agent(directory, packaged=each) for each in (False, True))
    assert not ours(caplog)
    calls = []
    (used,) = packaged.planner._functions._replaced.values()
    arguments, _ = packaged.planner.example_call(packaged.example())
    packaged.planner.replace_plan(arguments, lambda *args: (calls.append(0), used(*args))[1])
    for seed in range(3):
        torch.testing.assert_close(act(packaged, seed), act(eager, seed), atol=1e-4, rtol=1e-4)
    assert calls == [0] * 3


def test_the_users_own_package_is_taken(directory, caplog):
    assert load_agent(directory).planner._functions._replaced
    assert not load_agent(directory, packaged=False).planner._functions._replaced
    assert not load_agent(directory, compile=True).planner._functions._replaced
    assert load_agent(directory, planner=False).planner is None
    assert not ours(caplog)


def test_a_plan_that_was_taken_is_not_compiled_again_until_weights_change(directory, monkeypatch):
    agent, compiled = load_agent(directory), []
    monkeypatch.setattr(agent.planner, "compile_plan", compiled.append)
    assert agent.warm_up().compiled
    assert not compiled
    with torch.no_grad():
        agent.actor.module.mlp[0].bias.add_(0.1)
    agent.warm_up()
    assert len(compiled) == 1


@pytest.mark.parametrize("change", ["key", "signature", "no text", "package"])
def test_nothing_native_of_others_is_loaded_unless_asked(
    directory, tmp_path, monkeypatch, caplog, change
):
    def refuse(path):
        raise AssertionError("native code was loaded")

    monkeypatch.setattr(torch._inductor, "aoti_load_package", refuse)
    place = directory / package.PACKAGE_FILE
    if change == "key":
        monkeypatch.setenv(STATE_VARIABLE, str(tmp_path / "another"))
    elif change == "package":
        place.write_text(place.read_text() + " ")
    else:
        told = place.with_name(f"{place.name}.json")
        content = json.loads(told.read_text())
        signature = "0" * 64 if change == "signature" else "\ud800"
        told.write_text(json.dumps({**content, "signature": signature}))
    with caplog.at_level(logging.INFO, logger="phihp_torchrl"):
        assert act(load_agent(directory)).isfinite().all()
    assert "was not made by you on this machine" in caplog.text


def test_a_package_of_another_agent_is_refused(directory, tmp_path, caplog):
    other = make()
    with torch.no_grad():
        other.actor.module.mlp[0].bias.add_(0.1)
    shutil.copytree(save_agent(other, tmp_path / "other"), directory, dirs_exist_ok=True)
    agent = load_agent(directory, packaged=True)
    (said,) = ours(caplog)
    assert said.startswith("The agent plans eagerly")
    assert "agent_sha256" in said
    assert act(agent).isfinite().all()


@pytest.mark.parametrize(
    ("key", "value"),
    [("torch_version", "1.0"), ("platform", "Plan9"), ("processor", ["avx99"]), ("format", "x")],
)
def test_a_package_for_elsewhere_is_refused(directory, caplog, key, value):
    place = directory / f"{package.PACKAGE_FILE}.json"
    place.write_text(json.dumps({**json.loads(place.read_text()), key: value}))
    load_agent(directory, packaged=True)
    (said,) = ours(caplog)
    assert "package the agent again on this machine" in said
    assert key in said


def test_a_changed_or_missing_package_is_refused(directory, caplog):
    place = directory / package.PACKAGE_FILE
    place.write_text(place.read_text() + " ")
    load_agent(directory, packaged=True)
    place.unlink()
    load_agent(directory, packaged=True)
    changed, missing = ours(caplog)
    assert "expected sha256" in changed
    assert "expected a packaged plan, found none" in missing


def test_changed_weights_are_planned_by_eagerly(directory):
    packaged, eager = (load_agent(directory, packaged=each) for each in (None, False))
    for agent in (packaged, eager):
        with torch.no_grad():
            agent.actor.module.mlp[0].bias.add_(0.5)
        agent.qvalue.module.load_state_dict(
            {name: 2.0 * value for name, value in agent.qvalue.module.state_dict().items()}
        )
    torch.testing.assert_close(act(packaged), act(eager))


def test_another_agent_in_the_directory_ends_the_package(directory):
    save_agent(load_agent(directory), directory, metadata={"note": "the same agent"})
    assert load_agent(directory).planner._functions._replaced
    other = make()
    with torch.no_grad():
        other.actor.module.mlp[0].bias.add_(0.1)
    save_agent(other, directory)
    assert not list(directory.glob(f"*{package.PACKAGE_FILE}*"))


def test_a_package_is_not_written_through_a_link(directory, tmp_path):
    theirs, made = tmp_path / "theirs", tmp_path / "made"
    theirs.write_text("not yours")
    made.write_text("a package")
    for name in (package.PACKAGE_FILE, package.PACKAGE_NOTE):
        (directory / name).unlink()
        (directory / name).symlink_to(theirs)
    place_package(made, directory)
    assert theirs.read_text() == "not yours"
    assert (directory / package.PACKAGE_FILE).read_text() == "a package"


def test_a_package_that_finds_another_plan_is_refused(directory, saved, caplog, monkeypatch):
    def off(*args):
        return [10.0 + each for each in saved[1](*args)]

    monkeypatch.setattr(torch._inductor, "aoti_load_package", lambda path: loaded(off))
    load_agent(directory, packaged=True)
    assert "expected the plan of this agent" in ours(caplog)[0]


def test_what_has_no_plan_has_no_package(tmp_path, caplog):
    alone = make(planner_config=None)
    with pytest.raises(AgentError, match="packaged: expected an agent with a planner"):
        save_agent(alone, tmp_path, packaged=True)
    save_agent(alone, tmp_path)
    load_agent(tmp_path, packaged=True)
    assert "expected an agent that plans" in caplog.text
    with pytest.raises(AgentError, match="without compile, got both"):
        load_agent(tmp_path, packaged=True, compile=True)


def test_an_adaptive_integrator_has_no_package(tmp_path):
    agent = make(dynamics=HybridDynamics.hybrid(get_task("pendulum"), integrator="dopri5"))
    with pytest.raises(AgentError, match="integrator does not compile"):
        save_agent(agent, tmp_path, packaged=True)


def test_warm_up_compiles_in_the_foreground():
    agent = make()
    agent.planner._compile = {"backend": "eager"}
    expected = act(agent)
    state = torch.get_rng_state()
    found = agent.warm_up()
    assert found.ready
    assert found.compiled
    assert torch.equal(torch.get_rng_state(), state)
    torch.testing.assert_close(act(agent), expected)
    assert not make(planner_config=None).warm_up().compiled


def test_warm_up_says_what_does_not_compile(caplog):
    agent = make(dynamics=HybridDynamics.hybrid(get_task("pendulum"), integrator="dopri5"))
    with caplog.at_level(logging.WARNING):
        assert not agent.warm_up(background=True).compiled
    assert "integrator does not compile" in caplog.text


def test_warm_up_says_what_another_process_cannot_be_given(caplog):
    agent = make()
    agent.metadata["function"] = lambda: None
    found = agent.warm_up(background=True)
    assert found.ready
    assert "another process cannot be given the agent" in caplog.text


def test_an_agent_stays_eager_where_the_other_process_fails(monkeypatch, caplog):
    child = "phihp_torchrl.compilation.other_process._CHILD"
    monkeypatch.setattr(child, "raise SystemExit('no room')")
    agent = make()
    expected = act(agent)
    assert not agent.warm_up(background=True).wait(60)
    assert "stays eager: no room" in caplog.text
    torch.testing.assert_close(act(agent), expected)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_another_process_compiles_the_plan():
    """By Inductor; other tests of compiled plans take a backend that is quicker at it."""
    agent = make(planner_config=SMALLEST)
    expected = act(agent)
    found = agent.warm_up(background=True)
    torch.testing.assert_close(act(agent), expected)  # eagerly, in the meantime
    with pytest.raises(TimeoutError, match="still compiling"):
        found.wait(0.01)
    assert found.wait(500)
    assert found.package.stat().st_size > 0
    torch.testing.assert_close(act(agent), expected, atol=1e-4, rtol=1e-4)
