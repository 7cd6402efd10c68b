"""Where metrics go: the table, wandb, TensorBoard, and none of them ends a run."""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from phihp_torchrl.trainers import LoggerConfig, RunLogger, make_logger, run, run_loop
from phihp_torchrl.trainers.metrics_table import MetricsTable

from .run_parts import CONFIG


def test_the_table_grows_columns_and_forgets_rows(tmp_path: Path) -> None:
    table = MetricsTable(tmp_path / "metrics.csv")
    table.append({"unit": 0, "a": 1.0})
    before = table.path.read_text()
    table.append({"unit": 1, "a": 2.0, "b": 3.0})
    MetricsTable(table.path, table.rows[:1])
    assert table.path.read_text() == before


@pytest.mark.parametrize("cause", ["absent", "without a key", "tensorboard absent"])
def test_a_logger_that_fails_gives_way_to_the_csv(
    cause: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    config = LoggerConfig(name="wandb", mode="online")
    if cause == "absent":
        monkeypatch.setitem(sys.modules, "wandb", None)
    elif cause == "without a key":
        pytest.importorskip("wandb")
        for name in ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
        monkeypatch.setenv("WANDB_CONFIG_DIR", str(tmp_path))
        monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("it asked a question"))
    else:
        config = LoggerConfig(name="tensorboard")
        monkeypatch.setattr("torchrl.record.loggers.tensorboard._has_tb", False)
    with caplog.at_level(logging.WARNING):
        logger = make_logger(config, {}, tmp_path)
    assert type(logger) is RunLogger
    assert f"logger={config.name}" in caplog.text
    logger.log({"real_steps": 1}, 0)
    logger.close()


def test_a_logger_that_fails_later_does_not_end_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Broken(RunLogger):
        def log(self, metrics: Any, unit: int) -> None:
            raise OSError("the network is gone")

    monkeypatch.setattr(run_loop, "make_logger", lambda *_, **__: Broken())
    assert run(replace(CONFIG, phases=("model",)), tmp_path / "run").finished
    assert "the network is gone" in caplog.text


class FakeRun:
    """What the logger uses of a wandb run."""

    id = "abc"

    def __init__(self) -> None:
        self.rows: dict[int, dict[str, Any]] = {}
        self.axes: list[Any] = []

    def define_metric(self, name: str, step_metric: str | None = None) -> None:
        self.axes.append((name, step_metric))

    def log(self, row: dict[str, Any], step: int) -> None:
        self.rows.setdefault(step, {}).update(row)

    def log_artifact(self, artifact: Any) -> None:
        self.artifact = artifact

    def finish(self) -> None:
        self.finished = True


def test_wandb_gets_everything_and_goes_on_with_its_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wandb = pytest.importorskip("wandb")
    options: list[dict[str, Any]] = []
    fake = FakeRun()
    monkeypatch.setattr(wandb, "init", lambda **kwargs: options.append(kwargs) or fake)
    config = replace(CONFIG, logger=LoggerConfig(name="wandb", mode="offline", tags=("t",)))
    run(replace(config, phases=("model", "policy")), tmp_path / "run")
    assert options[0]["mode"] == "offline"
    assert options[0]["config"]["policy"]["td3"]["gamma"] == 0.99
    assert options[0]["id"] is None
    assert fake.axes == [("real_steps", None), ("*", "real_steps")]
    assert sorted(fake.rows) == list(range(5))
    assert fake.rows[0]["real_steps"] == 30
    last = replace(config, phases=("evaluate",), start_from=str(tmp_path / "run"))
    run(last, tmp_path / "last")
    assert fake.artifact.type == "agent"
    assert "evaluate/episode.png" in fake.rows[7]
    logger = make_logger(config.logger, {}, tmp_path, run_id="abc", resume_unit=3)
    assert options[-1]["id"] == logger.id == "abc"
    assert options[-1]["resume"] == "allow"


def test_tensorboard_logs_and_forgets(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    config = LoggerConfig(name="tensorboard")
    for units, resume in ((range(5), None), (range(3, 6), 3)):
        logger = make_logger(config, {}, tmp_path, resume_unit=resume)
        for unit in units:
            logger.log({"real_steps": unit, "phase": "model", "x": 1.0}, unit)
        logger.close()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [event.step for event in events.Scalars("x")] == list(range(6))
