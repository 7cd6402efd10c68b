"""Tables for Markdown."""

from __future__ import annotations

import pytest

from phihp_torchrl.evaluation import TaskResult, markdown_table, mean_and_std, returns_table


def test_tables():
    text = markdown_table(["a", "b"], [["x|y", "1"], ["z", "2"]])
    assert text == "| a | b |\n|:---|---:|\n| x\\|y | 1 |\n| z | 2 |\n"
    with pytest.raises(ValueError, match="rows: expected 2 cells, got 1"):
        markdown_table(["a", "b"], [["x"]])
    text = returns_table(
        [
            TaskResult("cartpole", 5000, planner=(500.0, 500.0, 497.0), actor=(480.0,)),
            TaskResult("cartpole-swingup", 500, actor=(400.0, 410.0)),
        ]
    )
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()[2:]]
    assert rows == [
        ["cartpole", "3", "5000", "499.0 ± 1.7", "480.0", "500", "500 ± 0", "5000"],
        ["cartpole-swingup", "2", "500", "–", "405.0 ± 7.1", "420", "–", "–"],
    ]
    assert mean_and_std([-1.25, -1.75], 2) == "−1.50 ± 0.35"
