"""Is a printed command one that there is, and do its settings fit? Nothing is run."""

from __future__ import annotations

import re
import shlex
from importlib.util import find_spec
from pathlib import Path

from phihp_torchrl.commands.console import COMMANDS
from phihp_torchrl.commands.evaluate import PlayConfig
from phihp_torchrl.commands.export import ExportConfig
from phihp_torchrl.commands.identify import IdentifyJob
from phihp_torchrl.commands.identifying import SHARED
from phihp_torchrl.commands.list import ListConfig
from phihp_torchrl.commands.train import split_flags
from phihp_torchrl.commands.words import read_words
from phihp_torchrl.config import from_mapping, load_config, override_key, parse_overrides
from phihp_torchrl.identification import IdentifyConfig
from phihp_torchrl.trainers import import_plugins, read_run_config
from tests.docs.blocks import ROOT

OTHERS = ("pip", "wandb", "tensorboard", "apt")
"""Programs that are not ours."""


def check_command(line: str) -> None:
    """Raise if ``line`` names what there is not."""
    program, *words = shlex.split(line, comments=True)
    if program == "phihp":
        _check_phihp(words[0], words[1:])
    elif program == "make":
        targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert words[0] in targets, f"make has no target {words[0]!r}"
    elif program == "python" and words[0] == "-m":
        assert find_spec(words[1]) is not None, f"there is no module {words[1]}"
    elif program == "python":
        _check_script(words[0], words[1:])
    else:
        assert program in OTHERS, f"unknown program {program!r}"


def _check_phihp(command: str, words: list[str], method: str | None = None) -> None:
    assert command in COMMANDS, f"phihp has no command {command!r}"
    if command == "train":
        _check_train(words, method)
    elif command == "identify":
        _check_identify(words)
    elif command == "list":
        read_words(ListConfig, words)
    else:
        config = read_words({"evaluate": PlayConfig, "export": ExportConfig}[command], words)
        if config.agent.startswith("results/"):
            assert (ROOT / config.agent / "agent.json").is_file(), f"no agent in {config.agent}"


def _check_train(words: list[str], method: str | None) -> None:
    settings, config_dir = split_flags(words)
    if {"-m", "--multirun"} & set(words):  # the first value of each that varies
        settings = [re.sub(r"^([\w.]+=[^,\[]+),.*$", r"\1", word) for word in settings]
    if method is not None and not any(word.startswith("method=") for word in settings):
        settings.append(f"method={method}")
    lines = parse_overrides(settings)
    named = {override_key(line): line for line in lines}
    if "plugins" in named:
        import_plugins(list(named["plugins"].value()))
    composed = load_config(overrides=settings, config_dir=config_dir)
    read_run_config(composed, given=list(named))


def _check_identify(words: list[str]) -> None:
    settings, config_dir = split_flags(words)
    job = read_words(IdentifyJob, settings)
    import_plugins(job.plugins)
    from_mapping(IdentifyConfig, job.identify)
    shared = [word for word in settings if word.split("=")[0].split(".")[0] in SHARED]
    load_config(overrides=shared, config_dir=config_dir)


def _check_script(script: str, words: list[str]) -> None:
    path = ROOT / script
    if "/" not in script:  # a file that a page prints
        path = Path(script)
    assert path.is_file(), f"there is no {script}"
    source = path.read_text()
    for word in words:
        if word.startswith("--"):
            assert f'"{word}"' in source, f"{script} has no option {word}"
    if called := re.search(r'main\(command="(\w+)"(?:, method="([\w-]+)")?\)', source):
        _check_phihp(called[1], words, called[2])
