"""Learning curves as pictures."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

__all__ = ["plot_comparison", "plot_learning_curve", "smooth"]

# Okabe and Ito's palette, told apart by colour-blind readers too. A method of the paper's Figure 1
# has its colour there in every picture.
METHOD_COLOURS = {"ecpo": "#0072B2", "urex": "#009E73", "ment": "#D55E00"}
COLOURS = ("#CC79A7", "#E69F00", "#56B4E9", "#000000", *METHOD_COLOURS.values())


def smooth(values: np.ndarray, fraction: float = 0.02) -> np.ndarray:
    """Mean over a trailing window, that many times as long as the curve.

    Args:
        values: ``[n]``.
        fraction: of n; at least one value.

    Examples:
        >>> smooth(np.array([0.0, 2.0, 4.0, 6.0]), fraction=0.5).tolist()
        [0.0, 1.0, 3.0, 5.0]
    """
    window = max(int(len(values) * fraction), 1)
    sums = np.cumsum(np.concatenate([np.zeros(1), values]))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def plot_learning_curve(
    rows: Sequence[Mapping[str, float]],
    path: Path,
    *,
    metrics: Sequence[str],
    title: str,
    x_label: str,
) -> Path:
    """Draw the record of one run, a panel for each metric that it has; return ``path``."""
    present = [metric for metric in metrics if any(metric in row for row in rows)]
    figure = Figure(figsize=(4.2 * max(len(present), 1), 3.2), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, max(len(present), 1)))
    for panel, metric in zip(panels, present, strict=False):
        measured = [(row["step"], row[metric]) for row in rows if metric in row]
        steps, values = np.array(measured, dtype=float).T
        panel.plot(steps, values, color=METHOD_COLOURS["ecpo"], alpha=0.25, linewidth=1)
        panel.plot(steps, smooth(values), color=METHOD_COLOURS["ecpo"])
        panel.set_ylabel(metric)
        _decorate(panel, x_label)
    figure.suptitle(title)
    figure.savefig(path, dpi=120)
    return path


def plot_comparison(
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]],
    path: Path,
    *,
    title: str,
    x_label: str,
    y_label: str,
) -> Path:
    """Draw mean and standard error of several runs of each method; return ``path``.

    Args:
        curves: by method, the steps ``[n]`` and the values ``[runs, n]``.
        path: of the picture; its ending is its format.
        title: of the picture.
        x_label: what a step is.
        y_label: what a value is.
    """
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    panel = figure.subplots()
    others = itertools.cycle(COLOURS)
    for method, (steps, values) in curves.items():
        colour = METHOD_COLOURS.get(method) or next(others)
        runs = len(values)
        mean = np.nanmean(values, axis=0)
        panel.plot(steps, mean, color=colour, label=f"{method} ({runs} runs)")
        if runs > 1:
            error = np.nanstd(values, axis=0, ddof=1) / np.sqrt(runs)
            panel.fill_between(steps, mean - error, mean + error, color=colour, alpha=0.2, lw=0)
    panel.set_title(title)
    panel.set_ylabel(y_label)
    panel.legend(frameon=False)
    _decorate(panel, x_label)
    figure.savefig(path, dpi=150)
    return path


def _decorate(panel: Axes, x_label: str) -> None:
    panel.set_xlabel(x_label)
    panel.grid(alpha=0.3)
    panel.spines[["top", "right"]].set_visible(False)
