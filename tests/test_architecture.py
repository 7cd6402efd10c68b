"""The order of the package's folders, its public names, and what importing it costs."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "phihp_torchrl"
FOLDERS = (
    "config",
    "compilation",
    "display",
    "integrators",
    "systems",
    "tasks",
    "recordings",
    "dynamics",
    "identification",
    "imagination",
    "agents",
    "planners",
    "baselines",
    "worlds",
    "deployment",
    "evaluation",
    "trainers",
    "tdmpc",
    "commands",
)
"""The folders, lowest first: each imports only lower ones."""

MODULES = ("origin",)
"""Modules outside the folders, which every folder may import."""


@cache
def nodes(path: Path) -> list[ast.AST]:
    """All nodes of a file's syntax tree."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def imported(path: Path) -> Iterator[tuple[str, ...]]:
    """The parts below ``phihp_torchrl`` of the modules that a file imports from the package."""
    for node in nodes(path):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: expected an absolute import"
            names = [str(node.module)]
            if node.module == "phihp_torchrl":  # of which folders and modules may be imported
                names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        for name in names:
            first, *parts = name.split(".")
            if first == "phihp_torchrl":
                yield tuple(parts)


def files() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def named(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def public_names() -> dict[str, list[str]]:
    """The names in ``__all__`` of the package and of its folders, by module."""
    names = {}
    for init in PACKAGE.rglob("__init__.py"):
        module = ".".join(init.parent.relative_to(ROOT).parts)
        names[module] = list(getattr(importlib.import_module(module), "__all__", ()))
    return names


def test_the_folders_are_those_on_disk() -> None:
    found = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert found == set(FOLDERS)
    assert {path.stem for path in PACKAGE.glob("*.py")} == {"__init__", "__main__", *MODULES}


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_imports_only_lower_ones(folder: str) -> None:
    allowed = {*FOLDERS[: FOLDERS.index(folder) + 1], *MODULES}
    wrong = [
        f"{named(path)}: {'.'.join(parts)}"
        for path in (PACKAGE / folder).rglob("*.py")
        for parts in imported(path)
        if parts and parts[0] in {*FOLDERS, *MODULES} - allowed
    ]
    assert wrong == []


@pytest.mark.parametrize("module", MODULES)
def test_modules_outside_the_folders_import_config_alone(module: str) -> None:
    assert {parts[0] for parts in imported(PACKAGE / f"{module}.py")} <= {"config"}


def test_no_import_goes_past_the_init_of_another_folder() -> None:
    places = [ROOT / "recipes", ROOT / "benchmarks"]
    wrong = []
    for path in (*files(), *(file for place in places for file in sorted(place.rglob("*.py")))):
        own = path.relative_to(PACKAGE).parts[0] if path.is_relative_to(PACKAGE) else None
        for parts in imported(path):
            if len(parts) > 1 and parts[0] != own:
                wrong.append(f"{named(path)}: {'.'.join(parts)}")
    assert wrong == []


def test_every_public_name_exists() -> None:
    missing = [
        f"{module}.{name}"
        for module, names in public_names().items()
        for name in names
        if not hasattr(importlib.import_module(module), name)
    ]
    assert missing == []


def test_every_public_name_is_listed_once_in_a_folder() -> None:
    assert {m: n for m, n in public_names().items() if len(n) != len(set(n))} == {}


def test_every_public_name_has_a_docstring_with_an_example() -> None:
    bare = set()
    for module, names in public_names().items():
        for name in names:
            doc = getattr(importlib.import_module(module), name).__doc__ or ""
            if ">>> " not in doc or "Examples:" not in doc:
                bare.add(f"{module}.{name}")
    assert bare == set()


def test_there_are_at_most_171_public_names() -> None:
    assert len({name for names in public_names().values() for name in names}) <= 171


def test_names_at_the_top_are_public_in_their_folder() -> None:
    import phihp_torchrl

    wrong = [
        f"{home}.{name}"
        for home, names in phihp_torchrl._HOMES.items()
        for name in names
        if name not in importlib.import_module(f"phihp_torchrl.{home}").__all__
    ]
    assert wrong == []
    assert sorted(phihp_torchrl.__all__) == sorted(phihp_torchrl._HOME_OF)


def test_only_commands_print() -> None:
    wrong = [
        f"{named(path)}:{node.lineno}"
        for path in files()
        if not path.is_relative_to(PACKAGE / "commands")
        for node in nodes(path)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "print"
    ]
    assert wrong == []


def test_importing_it_does_not_import_torch() -> None:
    code = "import sys, phihp_torchrl.config; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=120).returncode == 0


def test_texts_are_read_and_written_in_utf8_whatever_the_locale() -> None:
    """``read_text``, ``write_text`` and ``open`` of texts name their encoding."""
    others = ("Image", "h5py", "gzip", "os")  # whose ``open`` is another
    wrong = []
    for path in files():
        for node in nodes(path):
            function = node.func if isinstance(node, ast.Call) else None
            name = getattr(function, "attr", getattr(function, "id", ""))
            if name not in ("open", "read_text", "write_text"):
                continue
            if getattr(getattr(function, "value", None), "id", "") in others:
                continue
            texts = [a.value for a in node.args if isinstance(a, ast.Constant)]
            binary = any(isinstance(text, str) and "b" in text[:3] for text in texts)
            if not binary and "encoding" not in [word.arg for word in node.keywords]:
                wrong.append(f"{named(path)}:{node.lineno}")
    assert wrong == []
