"""Markdown tables of returns, beside those of the paper."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from phihp_torchrl.evaluation.published import PUBLISHED, TARGETS


@dataclass(frozen=True)
class TaskResult:
    """The returns of a method on a task, over seeds of training.

    Args:
        task: name of the task.
        samples: real samples used.
        planner: mean return of each seed's planner; empty if it was not evaluated.
        actor: mean return of each seed's actor alone.
        label: name of the method in the paper.
    """

    task: str
    samples: int
    planner: tuple[float, ...] = ()
    actor: tuple[float, ...] = ()
    label: str = "PhIHP"


def returns_table(results: Iterable[TaskResult]) -> str:
    """Make a table with a row for each result: mean ± std over seeds, target, published return.

    Published returns are those of the result's method; targets are those of PhIHP.

    Examples:
        >>> print(returns_table([TaskResult("pendulum", 200, planner=(-190.0, -188.0))]))
        | task | seeds | real samples | planner | actor alone | target | paper | paper samples |
        |:---|---:|---:|---:|---:|---:|---:|---:|
        | pendulum | 2 | 200 | −189.0 ± 1.4 | – | −220 | −263 ± 144 | 2000 |
        <BLANKLINE>
    """
    header = [
        "task",
        "seeds",
        "real samples",
        "planner",
        "actor alone",
        "target",
        "paper",
        "paper samples",
    ]
    rows = []
    for result in results:
        paper = PUBLISHED.get(result.task, {}).get(result.label)
        target = TARGETS.get(result.task) if result.label == "PhIHP" else None
        rows.append(
            [
                result.task,
                str(max(len(result.planner), len(result.actor))),
                str(result.samples),
                mean_and_std(result.planner),
                mean_and_std(result.actor),
                "–" if target is None else _number(target, 0),
                "–" if paper is None else f"{_number(paper.return_mean, 0)} ± {paper.return_std}",
                "–" if paper is None or paper.samples is None else f"{1000 * paper.samples:.0f}",
            ]
        )
    return markdown_table(header, rows)


def mean_and_std(values: Sequence[float], digits: int = 1) -> str:
    """``mean ± std`` over seeds (n - 1 in the denominator); of one value, the value.

    Examples:
        >>> mean_and_std([1.0, 3.0]), mean_and_std([2.0]), mean_and_std([])
        ('2.0 ± 1.4', '2.0', '–')
    """
    if not values:
        return "–"
    mean = sum(values) / len(values)
    if len(values) == 1:
        return _number(mean, digits)
    variance = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
    return f"{_number(mean, digits)} ± {variance**0.5:.{digits}f}"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Make a Markdown table with the first column left-aligned and the others right-aligned.

    Raises:
        ValueError: for a row of another length than the header.
    """
    lines = [header, [":---"] + ["---:"] * (len(header) - 1), *rows]
    text = ""
    for i, line in enumerate(lines):
        if len(line) != len(header):
            raise ValueError(f"rows: expected {len(header)} cells, got {len(line)}: {line}.")
        cells = [cell.replace("|", "\\|") for cell in line]
        text += f"|{'|'.join(cells)}|\n" if i == 1 else f"| {' | '.join(cells)} |\n"
    return text


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−")
