"""A disk that takes no more: the file is named, and what was written before stays whole."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from phihp_torchrl.config import file_error
from phihp_torchrl.trainers import run
from phihp_torchrl.trainers.lock import RunLock

from .tally import final_states, tally_config

resource = pytest.importorskip("resource")  # where the system has limits


@contextmanager
def room(size: int) -> Iterator[None]:
    """A context in which no file may grow beyond a size, by the system's own word."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.skipif(sys.platform != "linux", reason="which signal a limit sends differs")
@pytest.mark.usefixtures("tally")
def test_whatever_file_cannot_be_written_is_named_and_the_run_goes_on(tmp_path: Path) -> None:
    config = tally_config()
    assert run(config, tmp_path / "whole").finished
    written = [p for p in (tmp_path / "whole").rglob("*.[cjys]*") if p.is_file()]
    sizes = {p.name: p.stat().st_size for p in written}  # one of each name
    named = set()
    for number, size in enumerate(sorted(set(sizes.values()))):
        path = tmp_path / str(number)
        with room(size - 1), pytest.raises(OSError, match=str(path)) as caught:
            run(config, path)
        text = file_error(caught.value)
        assert "\n" not in text
        assert "File too large. This process may not write files of that size" in text
        named.add(Path(caught.value.filename).name)
        begun = (path / "config.yaml").is_file()
        assert ("go on with: " in text) == begun
        assert run(config, path, resume=begun).finished
        assert final_states(path) == final_states(tmp_path / "whole")
    assert {"metadata.json", "tensors.safetensors"} <= named


@pytest.mark.skipif(sys.platform != "linux", reason="which signal a limit sends differs")
def test_a_lock_without_a_name_is_given_up(tmp_path: Path) -> None:
    lock = RunLock(tmp_path)
    with room(10), pytest.raises(OSError, match=r"owner\.json"):
        lock.__enter__()
    with RunLock(tmp_path):
        assert (tmp_path / ".owner.json").is_file()
