"""No window opens, and registries are left as they were."""

from __future__ import annotations

import gymnasium as gym
import pytest

from phihp_torchrl.config import Registry
from phihp_torchrl.tasks import get_task, list_tasks
from phihp_torchrl.tasks import registry as tasks_registry
from phihp_torchrl.worlds import WORLDS
from phihp_torchrl.worlds.simulated import plant


@pytest.fixture(autouse=True)
def _no_window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")


@pytest.fixture
def registries(monkeypatch):
    """Copies of the registries, so that a test leaves nothing behind."""
    tasks = Registry("task")
    for name in list_tasks():
        tasks.register(name, get_task(name))
    monkeypatch.setattr(tasks_registry, "_TASKS", tasks)
    monkeypatch.setattr(plant, "_PLANTS", dict(plant._PLANTS))
    monkeypatch.setattr(WORLDS, "_entries", dict(WORLDS))
    monkeypatch.setattr("gymnasium.envs.registration.registry", dict(gym.registry))
    monkeypatch.setattr(gym, "registry", gym.envs.registration.registry)
