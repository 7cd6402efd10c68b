"""Pages name what there is: names of the API, links, and nothing of what has gone."""

from __future__ import annotations

import re
from importlib import import_module

import pytest

from tests.docs.blocks import PAGES, ROOT
from tests.test_architecture import FOLDERS

GONE = (
    rf"\bSPEC\b|(?<![\w.]){re.escape(str(ROOT))}/"  # a place on the machine of whoever wrote it
    r"|phihp_torchrl\.envs|recipes/config|recipes/presets|PlanSettings|MPPISettings"
    r"|HybridDynamics\.oracle|default_friction|friction_constants|WorldPhysics|PlanMemory|env_id"
    r"|register_envs|imagined_return\(|agents\.functional|trainers\.methods"
)


def directives(folder: str) -> list[str]:
    return re.findall(r"^::: (\S+)$", (ROOT / "docs" / "api" / f"{folder}.md").read_text(), re.M)


@pytest.mark.parametrize("folder", FOLDERS)
def test_an_api_page_has_the_public_names_of_its_folder(folder):
    module = import_module(f"phihp_torchrl.{folder}")
    shown = [name.removeprefix(f"phihp_torchrl.{folder}.") for name in directives(folder)]
    assert not set(module.__all__) - set(shown), "public names without a place on the page"
    for name in shown:
        assert hasattr(module, name), f"{folder} has no {name}"


def test_every_folder_has_an_api_page_and_a_row_in_the_readme():
    folders = {path.parent.name for path in (ROOT / "phihp_torchrl").glob("*/__init__.py")}
    assert folders == set(FOLDERS)
    readme, index = (ROOT / "README.md").read_text(), (ROOT / "docs/api/index.md").read_text()
    for folder in FOLDERS:
        assert f"(phihp_torchrl/{folder})" in readme
        assert f"[{folder}]({folder}.md)" in index


@pytest.mark.parametrize("page", PAGES)
def test_links_to_files_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", PAGES[page].read_text()):
        if "://" not in target:
            assert (PAGES[page].parent / target).exists(), f"{page}: {target}"


@pytest.mark.parametrize("page", PAGES)
def test_nothing_speaks_of_what_has_gone(page):
    found = re.findall(GONE, PAGES[page].read_text())
    assert not found, f"{page}: {found}"


@pytest.mark.parametrize("page", PAGES)
def test_files_that_a_page_names_are_there(page):
    """A path in code that begins with a folder of the package or of the repository."""
    for path in re.findall(
        r"`([a-z_]+/[\w/.-]+\.(?:py|yaml|md|json|csv))`", PAGES[page].read_text()
    ):
        folder = path.split("/")[0]
        if folder in FOLDERS:
            assert (ROOT / "phihp_torchrl" / path).is_file(), f"{page}: {path}"
        elif folder in ("phihp_torchrl", "recipes", "benchmarks", "docs", "results"):
            assert (ROOT / path).is_file(), f"{page}: {path}"
