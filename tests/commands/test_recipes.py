"""The recipes, run small from end to end."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from phihp_torchrl.deployment import load_agent

from .command_parts import BRIEF, EVALUATE, SMALL
from .conftest import Command


@pytest.mark.slow
def test_phihp_then_resume_then_evaluate(
    recipe: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trained = tmp_path / "run"
    recipe("phihp", "task=pendulum", f"run_dir={trained}", *SMALL, "evaluate.baselines=[lqr]")
    assert "| pendulum | 1 | 60 |" in capsys.readouterr().out
    assert (trained / "episode.gif").stat().st_size > 0
    assert not (tmp_path / "outputs").exists()
    # A finished run has nothing to resume; its settings are its own, whatever the defaults.
    recipe("phihp", f"resume={trained}")
    with pytest.raises(SystemExit, match="task: 'acrobot', not 'pendulum'"):
        recipe("phihp", f"resume={trained}", "task=acrobot")
    with pytest.raises(SystemExit, match=r"policy\.updates: 9, not 8"):
        recipe("phihp", f"resume={trained}", "policy.updates=9")
    recipe("phihp", f"resume={trained}", "logger=tensorboard", "checkpoint_interval=1")

    capsys.readouterr()
    shutil.copytree(trained / "agent", tmp_path / "agent")
    small = ("episodes=2", "latency_actions=3")
    recipe("evaluate", "agent=agent", *small)  # with the baselines that there are
    assert "| pendulum in simulated | planner | actor |" in capsys.readouterr().out
    results = json.loads((tmp_path / "agent" / "evaluation.json").read_text())
    assert results.keys() == {"planner", "actor", "baselines"}
    assert results["baselines"].keys() == {"lqr", "pid", "energy"}
    assert len(results["actor"]["returns"]) == 2
    assert (tmp_path / "agent" / "episode.png").exists()
    assert (tmp_path / "agent" / "episode.gif").exists()
    # What the run itself found: the same seeds, so the same returns.
    during = json.loads((trained / "evaluation.json").read_text())
    assert during["planner"]["returns"] == results["planner"]["returns"]
    assert during["baselines"]["lqr"]["returns"] == results["baselines"]["lqr"]["returns"]
    load_agent(tmp_path / "agent")  # what the recipe writes beside it does no harm

    alone = ("planner=false", "out_dir=there", "video=false", "baselines=none", *small)
    recipe("evaluate", "agent=agent", *alone)
    assert json.loads((tmp_path / "there" / "evaluation.json").read_text()).keys() == {"actor"}
    assert not (tmp_path / "there" / "episode.gif").exists()


@pytest.mark.slow
def test_td3_then_resume_then_evaluate(
    recipe: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = (
        *BRIEF,
        "compile=false",
        "td3.real_steps=40",
        "td3.random_steps=20",
        "td3.evaluation_interval=20",
        "td3.evaluation_episodes=2",
        "td3.actor_hidden_sizes=[8]",
        "td3.critic_hidden_sizes=[8]",
    )
    recipe("td3", "task=cartpole", "run_dir=run", *small)
    assert "| cartpole | 1 | 40 | – |" in capsys.readouterr().out
    recipe("td3", "resume=run")
    header, *rows = (tmp_path / "run" / "metrics.csv").read_text().splitlines()
    assert header.startswith("phase,unit,real_steps,seconds,return_mean,return_std")
    assert [row.split(",")[2] for row in rows[:2]] == ["20", "40"]
    recipe(*EVALUATE)
    assert "| cartpole in simulated | actor |" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="expected an agent that plans"):
        recipe("evaluate", "agent=run/agent", "planner=true")


@pytest.mark.slow
def test_tdmpc_then_resume_then_evaluate(
    recipe: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = (
        *BRIEF,
        "compile=false",
        "tdmpc.real_steps=60",
        "tdmpc.seed_steps=20",
        "tdmpc.batch_size=4",
        "tdmpc.replay_capacity=200",
        "tdmpc.evaluation_interval=30",
        "tdmpc.evaluation_episodes=2",
        "tdmpc.learn.told.mlp_dim=8",
        "tdmpc.planner.num_candidates=16",
    )
    recipe("tdmpc", "task=cartpole", "run_dir=run", *small)
    assert "| cartpole | 1 | 60 |" in capsys.readouterr().out
    recipe("tdmpc", "resume=run")
    header = (tmp_path / "run" / "metrics.csv").read_text().splitlines()[0]
    assert {"return_mean", "return_std", "tdmpc/td_error"} <= set(header.split(","))
    recipe(*EVALUATE)
    assert "| cartpole in simulated | planner | actor |" in capsys.readouterr().out


@pytest.mark.slow
def test_cem_then_evaluate(
    recipe: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ("planner.num_candidates=8", "planner.top_k=2", "planner.planning_horizon=2",
             "planner.optim_steps=1", "planner.replan_every=2", "compile=false",
             *BRIEF)  # fmt: skip
    recipe("cem", "task=pendulum", "run_dir=run", *small)
    assert "| pendulum | 1 | 0 |" in capsys.readouterr().out
    recipe(*EVALUATE)
    assert "| pendulum in simulated | planner |" in capsys.readouterr().out


@pytest.mark.slow
def test_the_demo_trains_and_shows(
    recipe: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recipe("demo", *SMALL)
    out = capsys.readouterr().out
    assert "| pendulum-swingup | 1 | 60 |" in out
    assert "The model has learned gravity_gain" in out
    assert {p.name for p in (tmp_path / "outputs" / "demo").iterdir()} == {
        "report.html",
        "episode.png",
        "episode.gif",
    }
    assert len(list((tmp_path / "outputs" / "pendulum-swingup").iterdir())) == 1


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("phihp", ["seed=-1"], "error: seed: expected"),
        ("phihp", ["+policy.td3.gama=1"], r"error: policy\.td3\.gama: unknown key"),
        ("phihp", ["phases=[evaluate]", "from=nowhere"], "error: nowhere: not the directory"),
        ("phihp", ["resume=nowhere"], "error: nowhere: not the directory"),
        ("phihp", ["plugins=[nowhere.py]"], r"error: plugins: nowhere\.py"),
        ("evaluate", [], r"error: agent: missing: expected agent=\.\.\."),
        ("evaluate", ["agent=nowhere"], "error: agent: nowhere: expected the directory"),
        ("evaluate", ["agent=nowhere", "planner=maybe"], "error: planner: expected one of"),
        (
            "evaluate",
            ["agent=nowhere", "episodes=0"],
            "error: episodes: expected a whole number >= 1",
        ),
        ("evaluate", ["agent=nowhere", "+speed=3"], "error: speed: unknown key"),
        ("demo", ["seed=-1"], "error: seed: expected"),
        ("demo", ["sead=1"], "error: .*sead"),
    ],
)
def test_a_wrong_argument_is_one_sentence_and_no_step(
    recipe: Command, tmp_path: Path, name: str, arguments: list[str], message: str
) -> None:
    with pytest.raises(SystemExit, match=f"(?s)^{message}"):
        recipe(name, *arguments)
    assert not list(tmp_path.rglob("*.csv"))
