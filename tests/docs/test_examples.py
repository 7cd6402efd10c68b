"""What README.md and docs/ print runs as it is printed, and says what is true."""

from __future__ import annotations

import ast
import io
import tokenize
from importlib import import_module
from typing import Any

import pytest
import yaml
from brief import shorten

from phihp_torchrl import learn
from tests.docs.blocks import BLOCKS, PAGES, SHELLS, Block, commands
from tests.docs.commands import check_command
from tests.docs.conftest import TINY

LANGUAGES = ("python", "yaml", "c", "cpp", "text", "bibtex", *SHELLS)
PLAIN = {"planner.num_policy_candidates": 0}
WIDTH = 84
"""Characters that a line of code has room for on a page."""


def python_pages() -> list[Any]:
    """Pages with Python to run, those with a slow block marked so.

    What a page has from README.md alone is run there.
    """
    pages = []
    first = {block.text for block in BLOCKS["README.md"]}
    for page, blocks in BLOCKS.items():
        if page.startswith("docs/tutorials/"):
            continue  # which have commands between their blocks, and a test of their own
        python = [block for block in blocks if block.language == "python" and not block.title]
        if page != "README.md" and all(block.text in first for block in python):
            continue
        if python:
            slow = any(block.mark == "slow" for block in python)
            marks = [pytest.mark.slow, pytest.mark.timeout(900)] if slow else []
            pages.append(pytest.param(page, marks=marks))
    return pages


@pytest.mark.parametrize("page", python_pages())
def test_python_runs_as_printed(page, place, small):
    """Blocks run in order in one namespace; a value in a comment is the value that comes out."""
    namespace: dict[str, Any] = {"__name__": "printed"}
    for block in BLOCKS[page]:
        if block.language == "python" and block.runs and block.title is None:
            run_block(block, namespace)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "settings", "metric"),
    [
        ("my_planner", {"planner": "shooting"}, "evaluate/planner/return_mean"),
        ("my_world", {"world": "noisy"}, "model/train_error"),
        ("my_phase", {"method": "probed-cem", **PLAIN}, "probe/residual_share"),
        ("my_method", {"method": "prior-cem", **PLAIN}, "evaluate/planner/return_mean"),
    ],
)
def test_printed_plugins_learn(module, settings, metric, place, monkeypatch):
    """What the pages add to the package from a file of their own works in a run."""
    shorten(monkeypatch)
    import_module(module)
    world = settings.pop("world", "simulated")
    small = {name: value for name, value in TINY.items() if name != "planner.num_kept_elites"}
    _, path = learn("pendulum", world, overrides={**small, **settings}, run_dir=place / "run")
    assert metric in (path / "metrics.csv").read_text().splitlines()[0].split(",")


@pytest.mark.parametrize("page", PAGES)
def test_blocks_are_well_formed(page):
    for block in BLOCKS[page]:
        assert block.language in LANGUAGES, f"{block.place}: a fence of language {block.language!r}"
        if block.language == "python":
            compile(block.text, block.place, "exec")
        elif block.language == "yaml":
            assert isinstance(yaml.safe_load(block.text), dict), block.place
        if block.language != "bibtex":
            wide = [line for line in block.text.splitlines() if len(line) > WIDTH]
            assert not wide, f"{block.place}: wider than {WIDTH}: {wide}"


@pytest.mark.parametrize(
    ("line", "where"),
    {
        line: pytest.param(line, where, id=line) for page in PAGES for where, line in commands(page)
    }.values(),
)
def test_commands_are_there_and_their_settings_fit(line, where, place):
    try:
        check_command(line)
    except Exception as error:
        pytest.fail(f"{where}: {line}: {type(error).__name__}: {error}")


def test_a_printed_syntax_error_is_found():
    block = Block("page.md", 3, "python", None, "register_task(Task(name='x', ...))\n")
    with pytest.raises(SyntaxError):
        run_block(block, {})


def test_a_printed_value_that_is_wrong_is_found():
    block = Block("page.md", 3, "python", None, "1 + 1  # 3\n")
    with pytest.raises(AssertionError, match=r"page\.md:3: prints 3, comes out as 2"):
        run_block(block, {})


def run_block(block: Block, namespace: dict[str, Any]) -> None:
    """Run a block's statements; an expression with a value in its comment must have that value."""
    tree = ast.parse(block.text, block.place)
    comments = comments_of(block.text)
    for node in tree.body:
        printed = comments.get(node.end_lineno or 0)
        if isinstance(node, ast.Expr) and printed is not None and is_value(printed):
            code = compile(ast.Expression(node.value), block.place, "eval")
            value = repr(eval(code, namespace))
            line = block.line + node.lineno - 1
            assert value == printed, f"{block.page}:{line}: prints {printed}, comes out as {value}"
        else:
            exec(compile(ast.Module([node], []), block.place, "exec"), namespace)


def comments_of(text: str) -> dict[int, str]:
    """The comment at the end of each line, by its number."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {t.start[0]: t.string.lstrip("# ") for t in tokens if t.type == tokenize.COMMENT}


def is_value(comment: str) -> bool:
    """Whether a comment is a Python value, and no words."""
    try:
        node = ast.parse(comment, mode="eval").body
    except SyntaxError:
        return False
    return not isinstance(node, ast.Name)
