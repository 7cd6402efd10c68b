"""The part of ``phihp train`` that needs torch: import, compose, run and print the result."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torchrl.checkpoint import CheckpointError

from phihp_torchrl.commands.words import file_error
from phihp_torchrl.config import (
    MODULE,
    ConfigError,
    compose_yaml,
    open_mappings,
    publish_offers,
)
from phihp_torchrl.evaluation import controllers_table, returns_table
from phihp_torchrl.trainers import (
    RunResult,
    read_controllers,
    read_request,
    read_result,
    resume_command,
    run,
)


def launch(words: Sequence[str], settings: Sequence[str], config_dir: str | None) -> None:
    """Let Hydra compose the settings and run one job or, with ``--multirun``, many.

    Args:
        words: the whole command line.
        settings: the assignments in it.
        config_dir: the directory of ``--config-dir``.

    Raises:
        ConfigError: for settings that cannot be composed.
    """
    if "-m" not in words and "--multirun" not in words:
        compose_yaml(settings, config_dir)  # whose errors name the key
    publish_offers(*([] if config_dir is None else [config_dir]))
    # Hydra's parser takes assignments in one place alone, and not on both sides of a flag.
    flags = [word for word in words if word not in set(settings)]
    sys.argv = [sys.argv[0], *flags, *open_mappings(settings)]
    hydra.main(version_base="1.3", config_path=f"pkg://{MODULE}", config_name="train")(job)()


def job(composed: DictConfig) -> None:
    """Run what Hydra composed, and print the returns of the agent."""
    try:
        request = read_request(composed, HydraConfig.get().overrides.task)
        result = run(request.config, request.path, resume=request.resume)
    except (ConfigError, CheckpointError) as error:
        sys.exit(f"error: {error}")
    except OSError as error:  # a full disk, a directory without permission, ...
        sys.exit(f"error: {file_error(error)}")
    except KeyboardInterrupt:
        sys.exit(130)
    tell(result)


def tell(result: RunResult) -> None:
    """Print the table of returns, or how to resume a run that was stopped."""
    if result.signal is not None and not result.finished:
        command = resume_command(result.path)
        print(f"\nStopped. Go on with: {command}")  # noqa: T201 (a console command)
        sys.exit(128 + result.signal)
    earned = read_result(result.path)
    if earned is not None:
        print(f"\n{returns_table([earned])}")  # noqa: T201
    if (beside := read_controllers(result.path)) is not None:
        print(f"{controllers_table('controller', beside)}")  # noqa: T201
    print(f"Everything is in {result.path}")  # noqa: T201
