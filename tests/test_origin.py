"""What results say of the code that made them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from phihp_torchrl import origin


def test_git_has_a_minute_and_then_nobody_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    def too_slow(words: list[str], *, timeout: float, **_: object) -> None:
        assert timeout >= 60
        raise subprocess.TimeoutExpired(words, timeout)

    monkeypatch.setattr(subprocess, "run", too_slow)
    assert origin.has_changes() is None


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_results_that_are_being_written_are_no_change_of_the_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, results = tmp_path / "code" / "origin.py", tmp_path / "results" / "found.json"
    for place in (code, results):
        place.parent.mkdir()
        place.write_text("1\n")
    who = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    for words in (["init", "-q"], ["add", "."], [*who, "commit", "-qm", "first"]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    monkeypatch.setattr(origin, "__file__", str(code))
    results.write_text("2\n")
    found = origin.describe_origin(seed=0)
    assert (len(found["commit"]), found["dirty"]) == (40, False)
    code.write_text("2\n")
    assert origin.describe_origin(seed=0)["dirty"] is True
    # The code that was imported is still that of the first commit.
    subprocess.run(["git", *who, "commit", "-qam", "second"], cwd=tmp_path, check=True)
    moved = origin.describe_origin(seed=0)
    assert (moved["commit"], moved["dirty"]) == (found["commit"], False)
    assert origin.ask_git(tmp_path, "rev-parse", "HEAD") != found["commit"]


def test_a_machine_is_told_by_its_processor() -> None:
    machine = origin.describe_origin(seed=0)["machine"]
    assert machine["processor"] == origin.processor_name()
    text = origin.machine_text({"machine": {**machine, "processor": "AMD EPYC"}})
    assert text.startswith(f"{machine['cpus']} cores (AMD EPYC), ")


def test_the_name_of_the_processor_is_what_linux_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "cpuinfo"
    file.write_text("processor\t: 0\nmodel name\t: AMD EPYC: 7B12\nmodel name\t: other\n")
    monkeypatch.setattr(origin, "_CPUINFO", file)
    origin.processor_name.cache_clear()
    try:
        assert origin.processor_name() == "AMD EPYC: 7B12"
        file.unlink()
        origin.processor_name.cache_clear()
        monkeypatch.setattr(origin.platform, "processor", lambda: "of another system")
        assert origin.processor_name() == "of another system"
    finally:
        origin.processor_name.cache_clear()
