"""Choices of a settings group that are registered from Python, besides those with a YAML file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore

YAML = Path(__file__).parent / "settings"
"""Directory of the YAML files, both in a checkout and in an installed wheel."""

_OFFERED: dict[tuple[str, str], dict[str, Any]] = {}


def offer(group: str, name: str, content: Mapping[str, Any]) -> None:
    """Make ``group=name`` a choice that sets ``content``; a YAML file of that name overrides it.

    Args:
        group: name of the group, e.g. ``"task"``.
        name: name of the choice.
        content: the settings of this choice, as a nested mapping from the top level.

    Examples:
        >>> offer("task", "my-task", {"task": "my-task"})
    """
    _OFFERED[group, name] = dict(content)


def offered(words: Sequence[str]) -> str:
    """What is offered, as a text that differs where anything does that ``words`` may choose.

    Of tasks, of which there may be many, those count whose name is in one of the words. All other
    offers do, for settings may choose one without a word.
    """
    found = {
        (group, name): content
        for (group, name), content in _OFFERED.items()
        if group != "task" or any(name in word for word in words)
    }
    return repr(found)


def groups() -> set[str]:
    """The names of all groups, those of directories and those of offers."""
    return {path.name for path in YAML.iterdir() if path.is_dir()} | {of for of, _ in _OFFERED}


def publish_offers(*config_dirs: str | Path) -> None:
    """Register with Hydra every offered choice without a YAML file here or in ``config_dirs``."""
    store = ConfigStore.instance()
    for (group, name), content in _OFFERED.items():
        file = Path(group, f"{name}.yaml")
        if not any((Path(place) / file).is_file() for place in (YAML, *config_dirs)):
            store.store(name, content, group=group, package="_global_")


@contextmanager
def published_offers(*config_dirs: str | Path) -> Iterator[None]:
    """Publish the offers for the time of one composition.

    Other applications of Hydra in the same process, such as a grid whose keys have the names of our
    groups, must not find them.
    """
    repo = ConfigStore.instance().repo
    names = {group for group, _ in _OFFERED}
    before = {group: dict(repo[group]) for group in names if group in repo}
    publish_offers(*config_dirs)
    try:
        yield
    finally:
        for group in names:
            repo.pop(group, None)
        repo.update(before)


def choices_of(group: str, config_dir: str | Path | None = None) -> list[str]:
    """List the names that a group may be set to, sorted.

    Args:
        group: the group, e.g. ``"task"``.
        config_dir: a directory of further YAML files.

    Examples:
        >>> choices_of("budget")
        ['fast', 'full']
    """
    places = [YAML, *([] if config_dir is None else [Path(config_dir)])]
    files = {path.stem for place in places for path in (place / group).glob("*.yaml")}
    return sorted(files | {name for of, name in _OFFERED if of == group})
