"""The table and the figure of the comparison, from committed results: ``python comparison.py``."""

from __future__ import annotations

import csv
from collections import defaultdict
from pathlib import Path
from statistics import fmean

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from torchrl_ecpo.experiment.compare import with_error
from torchrl_ecpo.experiment.figures import NEUTRAL, STYLE, colours_of, save_figure

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "sota-implementations/results/study"
METRICS = ("pass_at_1", "pass_at_8", "pass_at_64", "distinct_right", "entropy", "length")
Key = tuple[str, str, str]


def read_runs(study: str) -> dict[Key, list[list[dict[str, float]]]]:
    """By task, method and setting, the rows of each run: what was measured at each step."""
    seeds: dict[tuple[str, ...], list[dict[str, float]]] = defaultdict(list)
    with (RESULTS / study / "curves.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            key = (row["task"], row["method"], row["setting"], row["seed"])
            measured = {name: float(row[name]) for name in ("step", *METRICS) if row[name]}
            seeds[key].append(measured)
    runs: dict[Key, list[list[dict[str, float]]]] = defaultdict(list)
    for (task, method, setting, _), rows in seeds.items():
        runs[task, method, setting].append(rows)
    return runs


def at_the_end(rows: list[dict[str, float]]) -> dict[str, float]:
    """The mean of each metric over the last tenth of a run."""
    late = [row for row in rows if row["step"] > 0.9 * rows[-1]["step"]]
    return {name: fmean(row[name] for row in late if name in row) for name in METRICS}


def at_the_start(rows: list[dict[str, float]]) -> dict[str, float]:
    """The first value of each metric."""
    return {name: next(row[name] for row in rows if name in row) for name in METRICS}


def cells(ends: list[dict[str, float]]) -> str:
    """Means over runs with standard errors, as the columns of a table."""
    specs = {name: ".3f" if name.startswith("pass") else ".2f" for name in METRICS}
    return " | ".join(
        with_error(np.array([end[name] for end in ends]), spec) for name, spec in specs.items()
    )


def table(study: str) -> list[str]:
    """A row for each task, method and setting: at the end of its runs."""
    rows = []
    for (task, method, setting), seeds in read_runs(study).items():
        ends = [at_the_end(rows) for rows in seeds]
        what = setting or f"{task.removesuffix('_by_trl')} | {len(ends)}"
        rows.append(f"| {method} | {what} | {cells(ends)} |")
    return rows


@matplotlib.rc_context(STYLE)
def draw(path: Path) -> None:
    """pass@64 over pass@1 at the end of each setting, by method and learning rate."""
    figure = Figure(figsize=(6.5, 3.8), layout="constrained")
    axes, runs = figure.subplots(), read_runs("llm_search")
    colours = colours_of(dict.fromkeys(method for _, method, _ in runs))
    for (_, method, setting), seeds in runs.items():
        ends = [at_the_end(rows) for rows in seeds]
        end = [fmean(each[name] for each in ends) for name in ("pass_at_1", "pass_at_64")]
        marker = "o" if setting.endswith("optim.lr 0.00025") else "^"
        axes.plot(*end, marker, color=colours[method])
    start = at_the_start(seeds[0])
    axes.plot(start["pass_at_1"], start["pass_at_64"], "*", color=NEUTRAL, markersize=10)
    for method, colour in colours.items():
        axes.plot([], [], "s", color=colour, label=method)
    for marker, label in {"o": "rate 0.00025", "^": "rate 0.0005", "*": "start"}.items():
        axes.plot([], [], marker, color=NEUTRAL, label=label)
    axes.set(xlabel="pass@1", ylabel="pass@64", title="Countdown, 3,840 completions, two seeds")
    figure.legend(loc="outside right upper")
    save_figure(figure, path)


if __name__ == "__main__":
    (rows, *_) = next(iter(read_runs("llm_search").values()))
    print(f"| at the start | | {cells([at_the_start(rows)])} |")
    for study in ("llm_search", "llm_comparison", "llm_longer", "llm_by_trl"):
        if (RESULTS / study).exists():
            print(*table(study), sep="\n")
    draw(ROOT / "docs/figures/llm_search.svg")
