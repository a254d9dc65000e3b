"""What is computed from the curves of runs: scores of each run, and aggregates by rliable."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from rliable.library import get_interval_estimates
from rliable.metrics import aggregate_iqm

REPETITIONS = 2000  # of the bootstrap


class Estimate(NamedTuple):
    """A number and the 95 % interval of a stratified bootstrap."""

    value: float
    low: float
    high: float


def steps_to_solve(steps: np.ndarray, values: np.ndarray, threshold: float) -> np.ndarray:
    """The step at which the metric first is at the threshold or above; infinite if never.

    Examples:
        >>> curves = np.array([[0.0, 5.0, 4.0], [0.0, 1.0, 2.0]])
        >>> steps_to_solve(np.array([10, 20, 30]), curves, 5.0).tolist()
        [20.0, inf]
    """
    is_solved = values >= threshold
    return np.where(is_solved.any(axis=1), steps[is_solved.argmax(axis=1)], np.inf)


def interquartile_means(scores: Mapping[str, np.ndarray]) -> dict[str, Estimate]:
    """Mean of the middle half of all runs on all tasks, by method.

    Args:
        scores: ``[runs, tasks]`` by method.
    """
    return _estimates(scores, lambda x: np.array([aggregate_iqm(x)]))


def probabilities_of_improvement(
    scores: Mapping[str, np.ndarray], method: str
) -> dict[str, Estimate]:
    """How likely a run of a method is better than one of each other, mean over tasks.

    Args:
        scores: ``[runs, tasks]`` by method.
        method: the one that is compared to each other.
    """
    pairs = {other: [scores[method], scores[other]] for other in scores if other != method}
    return _estimates(pairs, _probability_of_improvement)


def _probability_of_improvement(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """That of rliable, without the test that it makes on the way, thousands of times."""
    wins, ties = x[:, None] > y, x[:, None] == y
    return np.array([(wins + ties / 2).mean()])


def _estimates(scores, function) -> dict[str, Estimate]:
    # rliable draws from numpy's global generator, whatever random_state it is given.
    state = np.random.get_state()
    np.random.seed(0)
    try:
        values, intervals = get_interval_estimates(scores, function, reps=REPETITIONS)
    finally:
        np.random.set_state(state)
    return {
        name: Estimate(float(values[name][0]), *map(float, intervals[name][:, 0]))
        for name in values
    }
