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
