"""Learning curves as pictures."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from torchrl_ecpo.checks import as_fraction

__all__ = [
    "draw_curve",
    "plot_comparison",
    "plot_learning_curve",
    "save_figure",
    "smooth",
]

# Okabe and Ito's palette, told apart by colour-blind readers too. A method of the paper's figures
# has its colour in every picture.
METHOD_COLOURS = {
    "ecpo": "#0072B2",
    "urex": "#009E73",
    "ment": "#D55E00",
    "ecac": "#0072B2",
    "sac": "#009E73",
    "td3": "#D55E00",
    "ddpg": "#CC79A7",
}
COLOURS = ("#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999", "#0072B2", "#009E73", "#D55E00")
Curves = Mapping[str, tuple[np.ndarray, np.ndarray]]
"""By method, the steps ``[n]`` and the values ``[runs, n]``."""


def smooth(values: np.ndarray, fraction: float = 0.02) -> np.ndarray:
    """Mean over a trailing window, that many times as long as the curve.

    Args:
        values: ``[n]``.
        fraction: of n, from 0 to 1; at least one value.

    Raises:
        ValueError: for another fraction.

    Examples:
        >>> smooth(np.array([0.0, 2.0, 4.0, 6.0]), fraction=0.5).tolist()
        [0.0, 1.0, 3.0, 5.0]
    """
    fraction = as_fraction("fraction, of the smoothing,", fraction)
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
    panels: Mapping[str, Curves],
    path: Path,
    *,
    labels: Mapping[str, Mapping[str, str]],
    methods: Sequence[str],
    x_label: str,
    y_label: str,
) -> Path:
    """Draw mean and standard error of several runs of each method; return ``path``.

    Args:
        panels: by title, the curves of a task.
        path: of the picture; its ending is its format.
        labels: by title and method, what the legend says.
        methods: all that are compared, so that each has its colour in every panel.
        x_label: what a step is.
        y_label: what a value is.
    """
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(4.0 * columns, 3.2 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, columns)).flatten()
    colours = _colours(methods)
    for panel, (title, curves) in zip(axes, panels.items(), strict=False):
        for method, curve in curves.items():
            draw_curve(panel, *curve, color=colours[method], label=labels[title][method])
        panel.legend(frameon=False, fontsize="small")
        panel.set_title(title)
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
        _decorate(panel, x_label)
    for panel in axes[::columns]:
        panel.set_ylabel(y_label)
    for panel in axes[len(panels) :]:
        panel.set_visible(False)
    return save_figure(figure, path)


def draw_curve(
    panel: Axes, steps: np.ndarray, values: np.ndarray, *, color: str, label: str
) -> None:
    """Draw the mean over runs ``[runs, n]`` and, of two or more, a band of its standard error."""
    mean, runs = values.mean(axis=0), len(values)
    marker = "o" if len(steps) == 1 else None  # a line needs two points
    panel.plot(steps, mean, color=color, label=label, marker=marker)
    if runs > 1:
        error = values.std(axis=0, ddof=1) / np.sqrt(runs)
        panel.fill_between(steps, mean - error, mean + error, color=color, alpha=0.2, lw=0)


def _colours(methods: Collection[str]) -> dict[str, str]:
    """A colour for each method: its own, or else the next that is free, as long as there are."""
    taken = {METHOD_COLOURS.get(method.lower()) for method in methods}
    others = itertools.cycle([c for c in COLOURS if c not in taken] or COLOURS)
    return {method: METHOD_COLOURS.get(method.lower()) or next(others) for method in methods}


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a picture that depends on what it shows alone: no date, no random names."""
    with matplotlib.rc_context({"svg.hashsalt": "torchrl_ecpo"}):
        figure.savefig(path, dpi=150, metadata={"Date": None} if path.suffix == ".svg" else None)
    return path


def _decorate(panel: Axes, x_label: str) -> None:
    panel.set_xlabel(x_label)
    panel.grid(alpha=0.3)
    panel.spines[["top", "right"]].set_visible(False)
