"""The cache of derived equations on disk."""

from __future__ import annotations

import logging

import pytest
import sympy

from phihp_torchrl.systems import LagrangianSystem, derivation


class Falling(LagrangianSystem):
    """A mass that falls."""

    state_names, action_names = ("z", "z_dot"), ("lift",)
    velocity_of = {"z": "z_dot"}
    default_constants = {"mass": 2.0, "gravity": 9.81}

    def lagrangian(self, state, constants):
        return constants["mass"] * (state[1] ** 2 / 2 - constants["gravity"] * state[0])


class Lifted(Falling):
    def forces(self, state, action, constants):
        return {"z": action[0]}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache, which this process has not read yet, and a count of derivations."""
    monkeypatch.setenv(derivation.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(derivation, "_MADE", {})
    derive, count = derivation.Mechanics.derive, []
    monkeypatch.setattr(
        derivation.Mechanics, "derive", lambda self: count.append(self.key) or derive(self)
    )
    return tmp_path / "cache" / "systems", count


def again(kind=Falling):
    """Make a system as another process would."""
    derivation._MADE.clear()
    return kind()


def test_equations_are_derived_once_and_read_after_that(cache):
    folder, derived = cache
    first, second = again(), again()
    assert len(derived) == 1
    assert [path.name for path in folder.iterdir()] == [f"{derived[0]}.txt"]
    assert second.equations is not first.equations
    assert second.equations.source == first.equations.source
    assert Falling().equations is second.equations  # within a process from memory


def test_other_expressions_are_other_equations(cache):
    folder, derived = cache
    falling, lifted = again(), again(Lifted)
    assert len(set(derived)) == 2
    assert len(list(folder.iterdir())) == 2
    assert falling.equations.source != lifted.equations.source


def test_another_version_of_sympy_derives_anew(cache, monkeypatch):
    _, derived = cache
    again()
    monkeypatch.setattr(sympy, "__version__", "9.9")
    again()
    assert len(set(derived)) == 2


@pytest.mark.parametrize(
    "broken", [b"", b"no digest", b"\xff\xfe\x00", b"0" * 64 + b"\nraise SystemExit\n", None]
)
def test_a_broken_file_is_rebuilt(cache, broken):
    folder, derived = cache
    source = again().equations.source
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[:-3] if broken is None else broken)
    assert again().equations.source == source
    assert len(derived) == 2
    assert path.read_bytes() == whole


def test_a_folder_that_cannot_be_written_is_told(tmp_path, monkeypatch, cache, caplog):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv(derivation.CACHE_VARIABLE, str(tmp_path / "file"))
    with caplog.at_level(logging.WARNING):
        system = again()
    assert "Set PHIHP_CACHE_DIR to a folder that can be written" in caplog.text
    assert system.equations.source


def test_without_the_variable_it_is_the_users_cache(monkeypatch):
    monkeypatch.delenv(derivation.CACHE_VARIABLE)
    assert derivation.cache_dir().parts[-2:] == ("phihp_torchrl", "systems")
    monkeypatch.setenv(derivation.CACHE_VARIABLE, "~/mine")
    assert "~" not in str(derivation.cache_dir())
