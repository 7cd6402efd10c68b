"""Make every table and figure of the paper from the runs in results/runs/.

    python benchmarks/paper/make_report.py

Writes results/report/ (Markdown, CSV, SVG, PNG) and results/README.md. ``config/report.yaml`` has
every key.
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from phihp_torchrl.config import ConfigError, from_mapping
from phihp_torchrl.trainers import LoggerConfig, make_logger
from report import Report, ReportConfig, make_report


@hydra.main(version_base="1.3", config_path="config", config_name="report")
def main(composed: DictConfig) -> None:
    """Make the report and say what was left out."""
    mapping: Any = OmegaConf.to_container(composed, resolve=True)
    try:
        logger = from_mapping(LoggerConfig, mapping.pop("logger"), "logger")
        config = from_mapping(ReportConfig, mapping)
        report = make_report(config)
    except ConfigError as error:
        sys.exit(f"error: {error}")
    for problem in report.problems:
        print(problem)
    log(report, config, logger)
    print(f"wrote {Path(config.out) / 'README.md'}")


def log(report: Report, config: ReportConfig, logger: LoggerConfig) -> None:
    """Give the logger the figures."""
    directory = Path("outputs/report")
    directory.mkdir(parents=True, exist_ok=True)
    run = make_logger(logger, asdict(config), directory)
    for section in report.sections:
        for picture in section.pictures:
            path = Path(config.out) / "figures" / f"{picture.name}.png"
            run.log_file(f"report/{picture.name}", path, 0)
    run.close()


if __name__ == "__main__":
    main()
