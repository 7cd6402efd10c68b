"""Tasks by name."""

from __future__ import annotations

from dataclasses import replace

import pytest

from phihp_torchrl import get_task, load_config, register_task
from phihp_torchrl.config import ConfigError, Registry
from phihp_torchrl.systems import Pendulum
from phihp_torchrl.tasks import find_task, list_tasks, registry


@pytest.fixture
def tasks(monkeypatch):
    """A copy of the registry, so that a test leaves nothing behind."""
    copy = Registry("task")
    for name in list_tasks():
        copy.register(name, get_task(name))
    monkeypatch.setattr(registry, "_TASKS", copy)


@pytest.mark.usefixtures("tasks")
def test_a_task_of_the_users_own():
    system = Pendulum({"gravity": 1.6})
    task = register_task(replace(get_task("pendulum"), name="moon", system=system))
    assert get_task("moon") is task
    assert "moon" in list_tasks()
    with pytest.raises(ConfigError, match=r"^task: 'moon' is registered already"):
        register_task(task)
    heavier = replace(task, system=Pendulum({"mass": 2.0}))
    assert register_task(heavier, replace=True) is get_task("moon")


@pytest.mark.usefixtures("tasks")
def test_a_registered_task_needs_no_yaml_of_its_own():
    register_task(replace(get_task("pendulum"), name="yamlless"))
    assert load_config("yamlless")["task"] == "yamlless"


def test_unknown_tasks_are_named_with_those_there_are():
    with pytest.raises(ConfigError, match=r"^task: expected one of \['acrobot'.*got 'unicycle'"):
        get_task("unicycle")


def test_a_task_finds_itself():
    task = replace(get_task("pendulum"), name="nowhere")
    assert find_task(task) is task
    assert find_task("pendulum") is get_task("pendulum")
    assert list_tasks() == sorted(list_tasks())
