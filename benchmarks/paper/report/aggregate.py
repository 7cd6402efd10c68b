"""Performance over runs, by task and over tasks, with intervals of a stratified bootstrap.

Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice",
https://arxiv.org/abs/2108.13264.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from report.paper_systems import PaperSystem
from report.results import Results

METRICS = ("median", "IQM", "mean", "optimality gap")


@dataclass(frozen=True)
class Aggregate:
    """A system's performance over runs, and over tasks where there are several.

    Args:
        values: one for each of :data:`METRICS`, ``[4]``.
        low: lower ends of their 95 % intervals, ``[4]``.
        high: upper ends, ``[4]``.
        seeds: runs on each task.
    """

    values: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    seeds: int


def aggregates(scores: Mapping[str, NDArray[np.float64]], reps: int) -> dict[str, Aggregate]:
    """Median, interquartile mean, mean and optimality gap of each system.

    Args:
        scores: normalised returns ``[seeds, tasks]`` by system.
        reps: resamples of the bootstrap, the same ones at every call.

    Raises:
        ImportError: without the extra ``report``.
    """
    library, metrics = _rliable()

    def all_four(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array(
            [
                metrics.aggregate_median(matrix),
                metrics.aggregate_iqm(matrix),
                metrics.aggregate_mean(matrix),
                metrics.aggregate_optimality_gap(matrix),
            ]
        )

    found = {}
    for name, matrix in scores.items():
        with _same_draws():
            values, ends = library.get_interval_estimates({name: matrix}, all_four, reps=reps)
        found[name] = Aggregate(values[name], ends[name][0], ends[name][1], len(matrix))
    return found


def profiles(
    scores: Mapping[str, NDArray[np.float64]], thresholds: NDArray[np.float64], reps: int
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
    """Share of runs above each threshold ``[k]``, with the ends of its 95 % interval.

    Args:
        scores: normalised returns ``[seeds, tasks]`` by system.
        thresholds: normalised returns ``[k]``.
        reps: resamples of the bootstrap.

    Raises:
        ImportError: without the extra ``report``.
    """
    library, _ = _rliable()
    found: dict[str, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]] = {}
    for name, matrix in scores.items():
        with _same_draws():
            values, ends = library.create_performance_profile(
                {name: matrix}, thresholds, custom_profile_func=_share_above, reps=reps
            )
        found[name] = (values[name], ends[name][0], ends[name][1])
    return found


def score_matrix(
    results: Results, system: PaperSystem, tasks: Sequence[str]
) -> NDArray[np.float64] | None:
    """Normalised returns ``[seeds, tasks]``; ``None`` if there is no average over the tasks.

    Where tasks have been run with different numbers of seeds, the first ones of each are taken, as
    many as all have.
    """
    scores = results.averaged(system, tasks) or []
    columns = [[score.normalised for score in of_task] for of_task in scores]
    seeds = min(map(len, columns), default=0)
    return np.array([column[:seeds] for column in columns]).T if seeds else None


def _share_above(
    matrix: NDArray[np.float64], thresholds: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Share of scores above each threshold ``[k]``, all at once: rliable's own loops over them."""
    return (matrix.reshape(-1, 1) > thresholds).mean(axis=0)


def _rliable():  # type: ignore[no-untyped-def]  # two modules
    try:
        from absl import logging
        from rliable import library, metrics
    except ImportError as error:
        raise ImportError(
            f"rliable: expected it for intervals, it cannot be imported ({error}); "
            "`pip install 'phihp_torchrl[report]'` brings it."
        ) from error
    # When logging is set up anew, absl closes the stream that was stderr when it was imported,
    # which someone may have put there for a while and want back.
    logging.get_absl_handler().python_handler.stream = sys.__stderr__
    return library, metrics


@contextmanager
def _same_draws() -> Iterator[None]:
    """The same resamples each time: rliable draws from NumPy's global generator alone."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)
