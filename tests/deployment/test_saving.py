"""However a saving ends there is a whole agent; whatever is in a stranger's, nothing of it runs."""

from __future__ import annotations

import json
import os
import pickle
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from phihp_torchrl import load_agent, save_agent
from phihp_torchrl.commands.evaluate import PlayConfig, play
from phihp_torchrl.config import ConfigError, sealed
from phihp_torchrl.deployment import AgentError

from .agent_parts import act, make_agent, observations


class Killed(BaseException):
    """What ends a process in these tests."""


OPERATIONS = ("replace", "fsync", "mkdir", "unlink", "rmdir")


def killed_at(count: int, patch: pytest.MonkeyPatch) -> None:
    """End the process before its operation of that number on files."""
    left = [count]

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            left[0] -= 1
            if left[0] < 0:  # and nothing is done on the way out either, as none would be
                raise Killed
            return function(*arguments, **options)

        return call

    for name in OPERATIONS:
        patch.setattr(os, name, counted(getattr(os, name)))


def test_a_kill_at_any_operation_leaves_the_old_agent_or_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new = make_agent(), make_agent()
    td = observations(old, [2])
    expected = {0: act(old, td), 1: act(new, td)}
    seen = set()
    for count in range(20):
        place = tmp_path / str(count)
        save_agent(old, place, metadata={"seed": 0})
        with monkeypatch.context() as patch:
            killed_at(count, patch)
            try:
                save_agent(new, place, metadata={"seed": 1})
                over = True
            except Killed:
                over = False
        found = load_agent(place)
        assert torch.equal(act(found, td), expected[found.metadata["seed"]])
        seen.add(found.metadata["seed"])
        # And the next one is as if nothing had happened.
        save_agent(new, place, metadata={"seed": 1})
        assert {p.name for p in place.iterdir()} == {"agent.json", "weights.safetensors"}
        assert torch.equal(act(load_agent(place), td), expected[1])
        if over:
            break
    assert over
    assert seen == {0, 1}


def test_every_flipped_bit_is_noticed_or_changes_nothing(tmp_path: Path) -> None:
    agent = make_agent()
    save_agent(agent, tmp_path, metadata={"seed": 0, "acting": "actor"})
    td = observations(agent, [1])
    config, good = agent.config, act(load_agent(tmp_path), td)
    draw, refused = random.Random(0), 0
    for name in ("agent.json", "weights.safetensors"):
        data = (tmp_path / name).read_bytes()
        for _ in range(40):
            changed = bytearray(data)
            changed[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
            (tmp_path / name).write_bytes(changed)
            try:
                found = load_agent(tmp_path)
            except AgentError:
                refused += 1
                continue
            assert found.config == config
            assert torch.equal(act(found, td), good)
        (tmp_path / name).write_bytes(data)
    assert refused > 60


class Payload:
    """Unpickled, it leaves its mark."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.mark),)


def edit(place: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """A change that fits its digest."""
    content = json.loads((place / "agent.json").read_text())
    change(content)
    (place / "agent.json").write_text(sealed(content))


def named_world(content: dict[str, Any], mark: Path) -> None:
    world = {"kind": "torchrl", "make": "os:mkdir", "options": {"path": str(mark)}}
    content["metadata"]["config"] = {"world": world}


HOSTILE: dict[str, Callable[[Path, Path], Any]] = {
    "pickled weights": lambda place, mark: (place / "weights.safetensors").write_bytes(
        pickle.dumps(Payload(mark))
    ),
    "pickled description": lambda place, mark: (place / "agent.json").write_bytes(
        pickle.dumps(Payload(mark))
    ),
    "a kind of a module's": lambda place, mark: edit(place, lambda c: c.update(kind="os.mkdir")),
    "a task of a path's": lambda place, mark: edit(
        place, lambda c: c["task"].update(name="../../evil")
    ),
    "an integrator of a module's": lambda place, mark: edit(
        place, lambda c: c["dynamics"].update(integrator={"name": "os:system"})
    ),
    "a world that is code": lambda place, mark: edit(place, lambda c: named_world(c, mark)),
    "plugins": lambda place, mark: edit(
        place, lambda c: c["metadata"].update(config={"plugins": [str(place / "evil.py")]})
    ),
    "a giant header": lambda place, mark: (place / "weights.safetensors").write_bytes(
        (2**62).to_bytes(8, "little")
    ),
    "a giant file": lambda place, mark: os.truncate(place / "weights.safetensors", 10**11),
    "a pipe": lambda place, mark: (
        (place / "agent.json").unlink(),
        os.mkfifo(place / "agent.json"),
    ),
    "a device": lambda place, mark: (
        (place / "weights.safetensors").unlink(),
        (place / "weights.safetensors").symlink_to("/dev/zero"),
    ),
    "a pickle beside": lambda place, mark: (place / ".next-weights.safetensors").write_bytes(
        pickle.dumps(Payload(mark))
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_nothing_of_a_strangers_agent_is_executed(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, mark = tmp_path / "agent", tmp_path / "mark"
    save_agent(make_agent(), place, metadata={"seed": 0})
    (place / "evil.py").write_text(f"import os\nos.mkdir({str(mark)!r})\n")
    HOSTILE[name](place, mark)
    options: dict[str, Any] = {"episodes": 1, "latency_actions": 0, "video": False}
    options |= {"planner": False, "baselines": "none", "out_dir": str(tmp_path / "out")}
    monkeypatch.setattr("phihp_torchrl.evaluation.show_episode", lambda *_, **__: [])
    try:
        load_agent(place)
        play(PlayConfig(str(place), **options))
    except (AgentError, ConfigError) as error:
        refused = str(error)
    else:
        refused = ""
    assert not mark.exists()
    assert refused or name in ("plugins", "a pickle beside")
    if name == "a world that is code":
        assert "world: the agent's file names code" in refused
        with pytest.raises(Exception, match=r"."):  # it is none; but it was called
            play(PlayConfig(str(place), trust=True, **options))
        assert mark.exists()
