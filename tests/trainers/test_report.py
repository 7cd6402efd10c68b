"""The page of a run, what is said at its end, and what was expected at its start."""

from __future__ import annotations

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from pages import foreign, read
from tensordict import TensorDict

from phihp_torchrl.commands import tell
from phihp_torchrl.config import compose_yaml, load_config
from phihp_torchrl.tasks import get_task
from phihp_torchrl.trainers import RunResult, next_steps
from phihp_torchrl.trainers.expected import expect
from phihp_torchrl.trainers.real_data import collected_return
from phihp_torchrl.trainers.report import report_run, true_constants, write_report
from phihp_torchrl.trainers.run_directory import RunDirectory
from phihp_torchrl.trainers.run_request import read_request, read_run_config
from phihp_torchrl.worlds import make_world

from .run_parts import CONFIG

EVIL = '<script>alert("x")</script>'


@pytest.fixture
def copied(whole: Path, tmp_path: Path) -> Path:
    """A copy of a run, to be changed."""
    return Path(shutil.copytree(whole, tmp_path / "run"))


def words_of(page: str) -> str:
    return " ".join(" ".join(read(page).text).split())


def test_the_page_of_a_run_has_every_part_and_needs_nothing_from_elsewhere(whole: Path) -> None:
    page = (whole / "report.html").read_text()
    assert foreign(page) == []
    text = words_of(page)
    results = json.loads((whole / "evaluation.json").read_text())
    planner = results["planner"]["return_mean"]
    for words in (
        "How good the agent is", f"{planner:.4g}", "the actor alone",
        "while taking real steps", "While it trained in imagination",
        "An episode", "theta_dot", "torque", "The model predicts 20 steps",
        "How good the model is", "held-out error of one step",
        "gravity_gain", "true", "off by",
        "policy.updates", "12",
        "How to go on", f"evaluate agent={whole / 'agent'} episodes=200",
    ):  # fmt: skip
        assert words in text, words
    assert "alert" not in page
    metadata = json.loads((whole / "metadata.json").read_text())
    assert {"config", "digests"} <= metadata.keys()  # which say nothing to a reader
    assert "<h3>config" not in page
    assert "<h3>digests" not in page
    assert not any(digest in text for digest in metadata["digests"].values())


def test_the_page_is_safe_with_any_name_and_takes_what_is_there(copied: Path) -> None:
    directory = RunDirectory(copied)
    metadata = directory.read_metadata()
    metadata["sessions"][0]["command"] = [EVIL]
    metadata["policy"] = {"kept": EVIL}
    metadata["warnings"] = [f"Mind the {EVIL}."]
    directory.write_metadata(metadata)
    for name in ("episode.csv", "episode.png", "evaluation.json"):
        (copied / name).unlink()
    page = write_report(directory, {EVIL: 1.0})
    assert "<script>" not in page
    text = words_of(page)
    assert "An episode" not in text
    assert text.index(f"Mind the {EVIL}.") < text.rindex("How good the model is")
    (copied / "metrics.csv").unlink()
    assert "Settings that differ" in words_of(write_report(directory))


def test_a_page_that_fails_costs_no_run(
    copied: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (copied / "metadata.json").write_text("{")
    report_run(RunDirectory(copied), make_world("pendulum"))
    assert "No page of the run" in caplog.text


def test_true_constants_are_those_that_the_motion_determines() -> None:
    assert true_constants(make_world("pendulum")) == pytest.approx(
        {"gravity_gain": 15.0, "torque_gain": 3.0}
    )


def test_the_end_names_table_picture_and_two_commands(
    whole: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    tell(RunResult(whole, True, signal=None, metrics={}))
    out = capsys.readouterr().out
    assert "| brief-pendulum | 1 | 60 |" in out
    assert "The model has learned gravity_gain" in out
    assert str(whole / "report.html") in out
    assert str(whole / "episode.png") in out
    for _, command in next_steps(whole):
        assert command in out
    at_exit: list[tuple[object, ...]] = []
    monkeypatch.setattr("atexit.register", lambda *call: at_exit.append(call))
    with pytest.raises(SystemExit) as stopped:
        tell(RunResult(whole, False, signal=15, metrics={}))
    assert stopped.value.code == 143
    assert [code for _, code in at_exit] == [143]  # nothing that others wait for at the exit
    assert f"train resume={whole}" in capsys.readouterr().out


def test_a_run_of_the_first_phase_says_how_to_go_on(copied: Path) -> None:
    for name in ("agent", "phases/policy", "phases/evaluate"):
        shutil.rmtree(copied / name)
    ((_, command),) = next_steps(copied)
    assert "phases=[policy,evaluate]" in command
    assert f"from={copied}" in command


def test_commands_name_the_plugins_of_the_run(copied: Path) -> None:
    directory = RunDirectory(copied)
    directory.write_config({**directory.read_config(), "plugins": ["my_task.py", "rig"]})
    for _, command in next_steps(copied):
        assert "plugins=[my_task.py,rig]" in command
    for name in ("agent", "phases/policy", "phases/evaluate"):
        shutil.rmtree(copied / name)
    ((_, command),) = next_steps(copied)
    assert "plugins=[my_task.py,rig]" in command


@pytest.mark.parametrize(
    "words",
    [
        ("task=pendulum", "actuator.delay_steps=1", "action_rate_limit=20", "seed=3"),
        ("task=acrobot", "preset=paper", "planner=mppi", "logger=tensorboard", "logger.tags=[a b]"),
        ("task=pendulum", "constraints={theta_dot:{high:6.0}}", "compile=false", "budget=fast"),
        ("task=pendulum", "world.friction={joint:0.1}", "policy.td3.gamma='2 s'"),
        ("task=pendulum", "world=gymnasium", "world.id=Pendulum-v1", "world.options={g: 9.0}"),
        ("task=pendulum", "world=recorded", "world.files=[a/*.csv, b.csv]",
         "world.columns={theta: {column: angle, unit: deg}}", "calibrate.enabled=false"),
    ],
)  # fmt: skip
def test_the_phases_that_are_left_have_the_settings_of_the_run(
    words: tuple[str, ...], tmp_path: Path
) -> None:
    words = (*words, "phases=[model]")
    before = read_request(compose_yaml(words), words).config
    directory = RunDirectory(tmp_path / "run")
    directory.phase("model").mkdir(parents=True)
    directory.write_config(before.to_mapping())
    ((_, command),) = next_steps(directory.path)
    _, pasted = command.split(" train ")
    later = shlex.split(pasted)
    assert not [word for word in later if word.startswith(("run_dir", "model."))]
    after = read_request(compose_yaml(later), later).config
    assert after.phases_before == ("model",)
    assert replace(after, phases=before.phases, start_from=None) == before


def test_the_phases_that_are_left_have_the_folder_of_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    place = tmp_path / "conf" / "task" / "brief-pendulum.yaml"
    place.parent.mkdir(parents=True)
    place.write_text("# @package _global_\ntask: brief-pendulum\npresets: {default: {seed: 4}}\n")
    settings = load_config("brief-pendulum", overrides=["threads=2"], config_dir="conf")
    directory = RunDirectory("run")
    directory.phase("model").mkdir(parents=True)
    directory.write_config(read_run_config(settings).to_mapping())
    for command in (["phihp", "train", "--config-dir", "conf"], ["phihp", "--config-dir=conf"]):
        directory.write_metadata({"sessions": [{"command": command}]})
        ((_, pasted),) = next_steps(directory.path)
        assert " train --config-dir conf task=brief-pendulum " in pasted
        assert "threads=2" in pasted
        assert "seed=" not in pasted
    shutil.rmtree("conf")
    ((_, pasted),) = next_steps(directory.path)  # nothing is known of the task's own settings
    assert "config-dir" not in pasted
    assert "seed=4" in pasted


def test_a_world_in_which_no_command_can_act_is_not_played_in(copied: Path) -> None:
    directory = RunDirectory(copied)
    settings = directory.read_config()
    for world in ({"kind": "recorded", "files": "a.csv"}, {"kind": "given"}):
        directory.write_config({**settings, "world": world})
        ((_, command),) = next_steps(copied)
        assert " export " in command


def test_commands_are_quoted(copied: Path) -> None:
    moved = copied.rename(copied.with_name("my run; rm -rf"))
    assert all("'" in command for _, command in next_steps(moved))


def test_a_run_beside_it_tells_best_how_long_it_takes(copied: Path) -> None:
    directory = RunDirectory(copied)
    metadata = {**directory.read_metadata(), "seconds": {"model": 7, "policy": 8, "evaluate": 9}}
    directory.write_metadata(metadata)
    found = expect(CONFIG, copied.parent / "new")
    assert found.middle == {"model": 7.0, "policy": 8.0, "evaluate": 9.0}
    assert "Expected: 24 s, by the last run" in found.words()
    other = expect(replace(CONFIG, seed=5), copied.parent / "new")  # a seed changes no duration
    assert other.middle == found.middle
    unlike = expect(replace(CONFIG, compile=True), copied.parent / "new")
    assert set(unlike.middle.values()) == {None}  # nobody has run this task
    assert unlike.words().startswith("Nobody knows")


def test_twice_the_work_takes_twice_the_time(tmp_path: Path) -> None:
    pendulum = replace(CONFIG, task="pendulum")
    model = pendulum.section("model")
    more = replace(model, real_steps=2 * model.real_steps)
    twice = replace(pendulum, sections={**pendulum.sections, "model": more})
    once, found = (expect(c, tmp_path / "x").middle["model"] for c in (pendulum, twice))
    assert once is not None
    assert found == pytest.approx(2 * once)


def test_only_more_episodes_than_usual_take_longer(tmp_path: Path) -> None:
    pendulum = replace(CONFIG, task="pendulum")
    settings = pendulum.section("evaluate")
    found = []
    for episodes in (10, 50, 200):
        section = {"evaluate": replace(settings, episodes=episodes)}
        config = replace(pendulum, sections={**pendulum.sections, **section})
        found.append(expect(config, tmp_path / "x").middle["evaluate"])
    few, usual, many = found
    assert usual is not None
    assert (few, many) == (usual, pytest.approx(4 * usual))


def test_settings_unlike_those_that_were_measured_are_named(tmp_path: Path) -> None:
    def words(*changes: str, method: str = "phihp") -> str:
        settings = load_config("pendulum", method=method, overrides=[*changes])
        return expect(read_run_config(settings), tmp_path / "x").words()

    amounts = ("policy.updates=80000", "model.real_steps=5000", "evaluate.episodes=200", "seed=3")
    for same in (words(), words(*amounts), words(method="td3")):
        assert "by committed runs of it" in same
        assert "unlike" not in same
    for fewer in ("phases=[model]", "calibrate.enabled=false"):
        assert "unlike" not in words(fewer)
    some = words("phases=[model]", "model.ensemble=5", "policy.method=analytic")
    assert "unlike them here: model.ensemble=5. The" in some
    two = words("policy.method=analytic", "model.ensemble=5")
    assert "unlike them here: model.ensemble=5, policy.method=analytic. The time left" in two
    many = words(
        "planner.num_candidates=9", "planner.top_k=3", "policy.batch_size=8", "threads=2",
        "world.friction.damping=0.3",
    )  # fmt: skip
    assert "and 2 more" in many


def collected(done: list[bool], terminated: list[bool]) -> TensorDict:
    count = len(done)
    following = TensorDict(
        reward=torch.ones(count, 1),
        done=torch.tensor(done)[:, None],
        terminated=torch.tensor(terminated)[:, None],
        batch_size=[count],
    )
    return TensorDict(next=following, batch_size=[count])


def test_the_return_of_collected_steps() -> None:
    task, no = get_task("cartpole"), [False] * 6
    # Two episodes of two steps are over; the third was cut short by the end of the collection.
    over = [False, True, False, True, False, False]
    assert collected_return(task, collected([*over[:5], True], over)) == pytest.approx(2.0)
    assert collected_return(task, collected([*no[:5], True], no)) == task.max_steps
