"""Names and words in letters that the locale lacks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from phihp_torchrl.commands import letters


def run(words: list[str], place: Path, **environment: str) -> subprocess.CompletedProcess[bytes]:
    ascii_locale = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    return subprocess.run(
        [os.fsencode(sys.executable), *(word.encode() for word in words)],
        env={**os.environ, **ascii_locale, **environment},
        cwd=place,
        capture_output=True,
        check=False,
    )


def test_settings_and_output_have_any_letters_in_any_locale(tmp_path: Path) -> None:
    words = ["-m", "phihp_torchrl", "train", "--cfg", "job", "task=pendulum", "run_dir=größe−é"]
    done = run(words, tmp_path)
    assert done.returncode == 0, done.stderr.decode(errors="replace")
    assert b"run_dir: gr??e??" in done.stdout  # what this terminal can show of it
    done = run(words, tmp_path, PYTHONIOENCODING="utf-8")
    assert "run_dir: größe−é".encode() in done.stdout


def test_a_process_is_started_anew_once(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[dict[str, str]] = []
    monkeypatch.setattr(os, "execve", lambda _, __, environment: started.append(environment))
    letters.use_utf8()
    assert started == []  # UTF-8 it is
    monkeypatch.setattr(sys, "getfilesystemencoding", lambda: "iso8859-1")
    letters.use_utf8()
    (environment,) = started
    assert environment["PYTHONUTF8"] == "1"
    monkeypatch.setattr(os, "environ", environment)
    letters.use_utf8()
    assert len(started) == 1
