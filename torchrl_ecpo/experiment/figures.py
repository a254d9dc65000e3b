"""Learning curves as pictures, which are read on light and on dark pages."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter

from torchrl_ecpo.checks import as_float

__all__ = [
    "COLOURS",
    "METHOD_COLOURS",
    "NEUTRAL",
    "STYLE",
    "colours_of",
    "draw_curve",
    "plot_comparison",
    "plot_learning_curve",
    "save_figure",
    "smooth",
    "symbols",
]

NEUTRAL = "#7a7a7a"
"""The grey of text and axes. Its contrast is the same, 4.3, to white and to a dark page."""
WIDTH = 7.6  # inches, at most, which is what a page of text has: pictures are not scaled
STYLE: dict[Any, Any] = {
    "axes.edgecolor": NEUTRAL,
    "axes.labelcolor": NEUTRAL,
    "axes.titlesize": "medium",
    "figure.titlesize": "medium",
    "font.size": 9,
    "legend.frameon": False,
    "savefig.transparent": True,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "torchrl_ecpo",  # no random names
    "text.color": NEUTRAL,
    "xtick.color": NEUTRAL,
    "ytick.color": NEUTRAL,
}
"""Settings of matplotlib, for ``matplotlib.rc_context``."""

# After Okabe and Ito, told apart by colour-blind readers and on either page.
BLUE, GREEN, RED, PINK = "#0072B2", "#009E73", "#D55E00", "#CC79A7"
ORANGE, SKY, PURPLE, BROWN = "#E69F00", "#56B4E9", "#7B5FD0", "#9C6240"
COLOURS = (BLUE, GREEN, RED, PINK, ORANGE, SKY, PURPLE, BROWN)
"""Those that are given to methods without one in the table."""
METHOD_COLOURS = {
    **dict.fromkeys(("ecpo", "ecac", "ecacphi04", "centred"), BLUE),
    **dict.fromkeys(("urex", "sac", "sacphi04", "noprojection", "referencekept"), GREEN),
    **dict.fromkeys(("ment", "td3", "tau0", "dqn"), RED),
    **dict.fromkeys(("tpo", "ddpg", "plainreturns", "eq11"), PINK),
    **dict.fromkeys(("drgrpo", "grpo", "freshbatches", "k5andm5"), ORANGE),
    **dict.fromkeys(("pmdentropy", "pmdacentropy", "smallstartat1e3"), ORANGE),
    **dict.fromkeys(("reps", "tables", "aselsewhereat3e4"), SKY),
    **dict.fromkeys(("pmd", "pmdac", "squaredpmd", "kimispmd"), PURPLE),
    **dict.fromkeys(("nocontrolvariate", "tau02", "lr003", "k5andm2"), PURPLE),
    **dict.fromkeys(("repsentropy", "lstm", "aselsewhereat1e3"), BROWN),
    **dict.fromkeys(("smallstartat3e4", "ofthegroup", "windowoffour"), BLUE),
    **dict.fromkeys(("ofthebatch", "memoryless"), GREEN),
    **dict.fromkeys(("ppo", "recurrentppo", "crossq"), ORANGE),
    "tqc": RED,
    **dict.fromkeys(("sacphi04layernorm", "gradientsat3e4"), GREEN),
    **dict.fromkeys(("ecacphi04layernorm", "gradientsat1e3"), PURPLE),
}
"""The colour of a method in every picture, by the letters and digits of its name."""

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
    fraction = as_float("fraction, of the smoothing,", fraction, "[0, 1]")
    window = max(int(len(values) * fraction), 1)
    if window == 1:
        return values
    counts = np.minimum(np.arange(1, len(values) + 1), window)
    return np.convolve(values, np.ones(window))[: len(values)] / counts


@matplotlib.rc_context(STYLE)
def plot_learning_curve(
    rows: Sequence[Mapping[str, float]],
    path: Path,
    *,
    metrics: Sequence[str],
    title: str,
    x_label: str,
) -> Path | None:
    """Draw the record of one run, a panel for each metric that was measured.

    Args:
        rows: of the record; each has ``step``.
        path: of the picture; its ending is its format.
        metrics: those to draw.
        title: of the picture.
        x_label: what a step is.

    Returns:
        ``path``, or None if none of the metrics was measured: there is no picture then.
    """
    curves = {
        metric: [(row["step"], row[metric]) for row in rows if np.isfinite(row.get(metric, np.nan))]
        for metric in metrics
    }
    curves = {metric: points for metric, points in curves.items() if points}
    if not curves:
        return None
    figure, panels, _ = _grid(len(curves), x_label, columns=min(len(curves), 3))
    for panel, (metric, points) in zip(panels, curves.items(), strict=True):
        steps, values = np.array(points, dtype=float).T
        panel.plot(steps, values, color=BLUE, alpha=0.3, linewidth=1)
        marker = "." if len(steps) < 10 else None
        panel.plot(steps, smooth(values), color=BLUE, marker=marker)
        panel.set_title(metric)
    figure.suptitle(title)
    return save_figure(figure, path)


@matplotlib.rc_context(STYLE)
def plot_comparison(
    panels: Mapping[str, Curves],
    path: Path,
    *,
    x_label: str,
    y_label: str,
    levels: Mapping[str, Mapping[str, float]] | None = None,
) -> Path:
    """Draw mean and standard error of several runs of each method; return ``path``.

    Args:
        panels: by title, the curves of a task. Colours are those of the methods'
            :data:`METHOD_COLOURS`, in every panel the same.
        path: of the picture; its ending is its format.
        x_label: what a step is.
        y_label: what a value is.
        levels: by title and name, values that a line marks, such as where a task is solved.
    """
    columns = {1: 1, 2: 2, 4: 2}.get(len(panels), 3)
    figure, axes, spare = _grid(len(panels), x_label, columns)
    methods = dict.fromkeys(method for curves in panels.values() for method in curves)
    colours = colours_of(methods)
    marked = [levels[title] for title in panels if title in levels] if levels else []
    names = dict.fromkeys(name for each in marked for name in each)
    dashes = dict(zip(names, itertools.cycle(((0, (4, 3)), (0, (1, 2))))))
    entries = {}  # of the legend
    for panel, (title, curves) in zip(axes, panels.items(), strict=True):
        for name, value in (levels or {}).get(title, {}).items():
            entries[name] = panel.axhline(value, color=NEUTRAL, linewidth=1, linestyle=dashes[name])
        for method in reversed([*curves]):  # the first is on top
            entries[method] = draw_curve(
                panel, *curves[method], color=colours[method], label=symbols(method)
            )
        panel.set_title(title)
    figure.supylabel(y_label, fontsize="medium")
    legend = {symbols(name): entries[name] for name in (*methods, *names)}
    if spare is not None:
        spare.legend(legend.values(), legend.keys(), loc="center")
    elif columns == 1:
        figure.legend(legend.values(), legend.keys(), loc="outside right center")
    else:
        figure.set_figheight(figure.get_figheight() + 0.2 * -(-len(legend) // 5))
        figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=5)
    return save_figure(figure, path)


def _grid(count: int, x_label: str, columns: int) -> tuple[Figure, list[Axes], Axes | None]:
    """A figure, that many panels, and an empty place for a legend if one is left."""
    rows = -(-count // columns)
    figure = Figure(figsize=(WIDTH, 0.3 + 2.1 * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False).flatten())
    for panel in axes[:count]:
        panel.grid(color=NEUTRAL, alpha=0.25, linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        panel.xaxis.set_major_formatter(EngFormatter(sep=""))
    for panel in axes[:count][-columns:]:
        panel.set_xlabel(x_label)
    for panel in axes[count:]:
        panel.set_axis_off()
    return figure, axes[:count], axes[count] if count < len(axes) else None


def draw_curve(
    panel: Axes, steps: np.ndarray, values: np.ndarray, *, color: str, label: str
) -> Line2D:
    """Draw the mean over runs ``[runs, n]`` and, of two or more, a band of its standard error.

    Returns:
        The line, for a legend.
    """
    mean, runs = values.mean(axis=0), len(values)
    marker = "o" if len(steps) == 1 else None  # a line needs two points
    (line,) = panel.plot(steps, mean, color=color, label=label, marker=marker)
    if runs > 1:
        error = values.std(axis=0, ddof=1) / np.sqrt(runs)
        panel.fill_between(steps, mean - error, mean + error, color=color, alpha=0.2, lw=0)
    return line


def colours_of(methods: Iterable[str]) -> dict[str, str]:
    """A colour for each method: its own, or else the next that is free, as long as there are.

    Examples:
        >>> colours_of(["PMD+entropy", "mine"])
        {'PMD+entropy': '#E69F00', 'mine': '#0072B2'}
    """
    own = {m: METHOD_COLOURS.get("".join(filter(str.isalnum, m.lower()))) for m in methods}
    others = itertools.cycle([c for c in COLOURS if c not in own.values()] or COLOURS)
    return {method: colour or next(others) for method, colour in own.items()}


def symbols(text: str) -> str:
    """The text with the temperatures as letters.

    Examples:
        >>> symbols("tau' = 0, tau = 1")
        'τ′ = 0, τ = 1'
    """
    return re.sub(r"\btau\b", "τ", text).replace("τ'", "τ\N{PRIME}")


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a picture that depends on what it shows alone, without the date; return ``path``."""
    part = path.with_name(f".part-{path.name}")  # so that nobody sees a part if it is killed
    try:
        figure.savefig(part, dpi=150, metadata={"Date": None} if path.suffix == ".svg" else None)
        return part.replace(path)
    finally:
        part.unlink(missing_ok=True)
