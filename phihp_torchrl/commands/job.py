"""The part of ``phihp train`` that needs torch: import, compose, run and print the result."""

from __future__ import annotations

import atexit
import logging
import os
import sys
from collections.abc import Sequence

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torchrl.checkpoint import CheckpointError

from phihp_torchrl.config import (
    MODULE,
    ConfigError,
    compose_yaml,
    file_error,
    open_mappings,
    override_key,
    parse_overrides,
    publish_offers,
)
from phihp_torchrl.evaluation import controllers_table, returns_table
from phihp_torchrl.trainers import (
    NonFiniteError,
    RunResult,
    next_steps,
    read_controllers,
    read_learned,
    read_request,
    read_result,
    resume_command,
    run,
)

_SHOWN = {"report.html": "the page to read", "episode.png": "the picture", "episode.gif": "moving"}
"""Files that a run has for its reader, and what they are."""


def launch(words: Sequence[str], settings: Sequence[str], config_dir: str | None) -> None:
    """Let Hydra compose the settings and run one job or, with ``--multirun``, many.

    Args:
        words: the whole command line.
        settings: the assignments in it.
        config_dir: the directory of ``--config-dir``.

    Raises:
        ConfigError: for settings that cannot be composed.
    """
    if "-m" in words or "--multirun" in words:
        _check_folders(settings)
    else:
        compose_yaml(settings, config_dir)  # whose errors name the key
    publish_offers(*([] if config_dir is None else [config_dir]))
    # Hydra's parser takes assignments in one place alone, and not on both sides of a flag.
    flags = [word for word in words if word not in set(settings)]
    sys.argv = [sys.argv[0], *flags, *open_mappings(settings)]
    hydra.main(version_base="1.3", config_path=f"pkg://{MODULE}", config_name="train")(job)()


def _check_folders(settings: Sequence[str]) -> None:
    """Refuse a multirun of several runs in one folder, where the second would find the first."""
    lines = {override_key(line): line for line in parse_overrides(settings)}
    if not (swept := [key for key, line in lines.items() if line.is_sweep_override()]):
        return
    for key in ("run_dir", "resume"):
        if key in lines and key not in swept and "${" not in str(lines[key].value()):
            raise ConfigError(
                key,
                f"expected a folder for each run of the multirun over {', '.join(swept)}, got "
                f"{lines[key].value()!r} for all of them; without {key} each makes its own under "
                "outputs/.",
            )


def job(composed: DictConfig) -> None:
    """Run what Hydra composed, and print the returns of the agent."""
    try:
        request = read_request(composed, HydraConfig.get().overrides.task)
        result = run(request.config, request.path, resume=request.resume)
    except (ConfigError, CheckpointError, NonFiniteError) as error:
        sys.exit(f"error: {error}")
    except OSError as error:  # a full disk, a directory without permission, ...
        sys.exit(f"error: {file_error(error)}")
    except KeyboardInterrupt:
        sys.exit(130)
    tell(result)


def show_log() -> None:
    """Print what this package logs on the terminal, as ``phihp train`` does."""
    logging.basicConfig(format="%(message)s", stream=sys.stdout)
    logging.getLogger("phihp_torchrl").setLevel(logging.INFO)


def tell(result: RunResult) -> None:
    """Print the table of returns, the picture and what to do next; or how to go on with the run."""
    path = result.path
    if result.signal is not None and not result.finished:
        print(f"\nStopped. Go on with: {resume_command(path)}")  # noqa: T201 (a console command)
        # At its exit torch waits for the kernels that are being compiled, up to minutes. What is
        # registered last comes first.
        atexit.register(_leave, 128 + result.signal)
        sys.exit(128 + result.signal)
    earned = read_result(path)
    if earned is not None:
        print(f"\n{returns_table([earned])}")  # noqa: T201
    if (beside := read_controllers(path)) is not None:
        print(f"{controllers_table('controller', beside)}")  # noqa: T201
    if (learned := read_learned(path)) is not None:
        print(learned)  # noqa: T201
    print(f"Everything is in {path}")  # noqa: T201
    for name, words in _SHOWN.items():
        if (path / name).is_file():
            print(f"  {words + ':':<19}{path / name}")  # noqa: T201
    for what, command in next_steps(path):
        print(f"To {what}:\n  {command}")  # noqa: T201


def _leave(code: int) -> None:
    """End the process without what others do at its exit."""
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
