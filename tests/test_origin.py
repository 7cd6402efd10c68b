"""What results say of the code that made them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from phihp_torchrl import origin


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
