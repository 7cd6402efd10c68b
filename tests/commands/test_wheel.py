"""The wheel: everything that an installed package needs is in it."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def pip(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel; pip fetches what builds it, so without a network there is none."""
    place = tmp_path_factory.mktemp("wheel")
    built = pip("wheel", "--no-deps", "-w", place, ROOT)
    if built.returncode and "No matching distribution found for hatchling" in built.stderr:
        pytest.skip("hatchling, which builds it, cannot be had")
    assert built.returncode == 0, built.stderr
    return next(place.glob("*.whl"))


@pytest.mark.slow
def test_every_file_of_the_package_is_in_it_and_no_other(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if ".dist-info/" not in name}
    package = ROOT / "phihp_torchrl"
    ours = {str(path.relative_to(ROOT)) for path in package.rglob("*")
            if path.suffix in (".py", ".yaml", ".json") or path.name == "py.typed"}  # fmt: skip
    assert packed == ours
    assert "phihp_torchrl/py.typed" in packed
    assert "phihp_torchrl/config/settings/task/acrobot.yaml" in packed


@pytest.mark.slow
def test_it_works_from_an_empty_folder(wheel: Path, tmp_path: Path) -> None:
    site, empty = tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    with zipfile.ZipFile(wheel) as archive:  # which is what installing a pure wheel does
        archive.extractall(site)
    environment = {**os.environ, "PYTHONPATH": str(site)}
    command = [sys.executable, "-m", "phihp_torchrl"]
    for words, expected in (
        (["list"], "pendulum-swingup"),
        (["train", "task=acrobot", "--help"], "model.real_steps=2500"),
        (["train", "method=td-mpc", "--cfg", "job"], "method: td-mpc"),
    ):
        done = subprocess.run(
            [*command, *words], cwd=empty, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        assert expected in done.stdout
    where = [sys.executable, "-c", "import phihp_torchrl; print(phihp_torchrl.__file__)"]
    found = subprocess.run(where, cwd=empty, env=environment, capture_output=True, text=True)
    assert found.stdout.startswith(str(site)), "the wheel's, not the checkout's"
    assert not list(empty.iterdir())
