"""Turn committed results into the figures and tables of ``docs/study.md``.

``python report.py``; takes no run and no network, and writes the same files from the same results.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
from manifest import SCRIPTS, Manifest, Study, argument_parser, read_manifests
from matplotlib.figure import Figure
from results import RESULTS, CellResult, read_cells
from scores import (
    Estimate,
    interquartile_means,
    probabilities_of_improvement,
    steps_to_solve,
)

from torchrl_ecpo.experiment.compare import Curve, area, final, with_error
from torchrl_ecpo.experiment.figures import (
    NEUTRAL,
    STYLE,
    plot_comparison,
    save_figure,
    symbols,
)

DOCS = SCRIPTS.parent / "docs"
BEST = 3  # settings of a search that are listed
FEW_POINTS = 5  # fewer make no curve
# Metrics as figures name them.
METRIC_LABELS = {
    "expected_reward": "expected reward",
    "evaluation_return": "return",
    "ESS": "effective sample size",
    "distinct_solutions": "distinct solutions of a group",
    "pass_at_1": "pass@1",
    "pass_at_10": "pass@10",
    "pass_at_k": "pass@k",
    "long_attained": "attained at level 30",
}
SCORES = ("runs", "area", "final", "solved", "steps to solve")
INTRODUCTION = """# The study

<!-- Written by make report from sota-implementations/results: change what it is made from. -->

Every run, figure and table here follows from
[`study.yaml`](../sota-implementations/study/study.yaml), and every search of settings from
[`search.yaml`](../sota-implementations/study/search.yaml). What it all means is said in
[the results](results.md).

```bash
make study                                      # the runs; goes on where it was stopped
make study ARGS='--only figure1 --seeds 1-10 --stack 5'   # some of them, five in one process
make study ARGS='--missing'                     # those that this page says are missing
make report RUNS=runs/study                     # take their results in, and write this page
make report                                     # write it from the committed results
```

How to read the tables:

- **runs**: those that made all steps. "3 of 25 planned": the others have not, or not to the end.
- **area**: under the learning curve, over its length: the mean of the metric over the whole run.
- **final**: mean of the metric over the last tenth of the run. Both with standard error over runs.
- **solved**: share of runs that reached the threshold at any time, on average over a hundredth of
  the run.
- **steps to solve**: median over all runs; "> 240,000" if half of the runs or more never did.
- **minutes a run**: of wall-clock time, also where a run went on after these steps; of runs in one
  process, a share.
- Figures show the mean over runs and, of two runs or more, its standard error. A task on which most
  methods have one run, or fewer than five measurements, has rows in the tables and no panel.
- Intervals are 95 % intervals of a stratified bootstrap, by
  [rliable](https://github.com/google-research/rliable). The interquartile mean (IQM) is the mean of
  the middle half of all runs on all tasks.
- **better**: how likely a run of the first method has a larger area, or ends higher, than one of
  the other, a tie counting half (the probability of improvement); over several tasks, the mean.
  Where the interval has 0.5 in it, the runs leave open which is better. With two or three runs
  intervals are too narrow.
"""


# ------------------------------------------------------------------------------------------ tables


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def in_digits(values: np.ndarray) -> str:
    """Mean and standard error, with as many digits as the size of the mean asks for.

    Examples:
        >>> in_digits(np.array([10.0, 14.0]))
        '12.0 ± 2.0'
    """
    size = abs(values.mean())
    return with_error(values, f",.{3 if size < 2 else 1 if size < 200 else 0}f")


def in_ranges(seeds: Iterable[int]) -> str:
    """Seeds as they are written in a manifest.

    Examples:
        >>> in_ranges([1, 2, 3, 7])
        '1-3, 7'
    """
    ranges: list[list[int]] = []
    for seed in sorted(seeds):
        if ranges and ranges[-1][-1] == seed - 1:
            ranges[-1].append(seed)
        else:
            ranges.append([seed])
    return ", ".join(f"{r[0]}-{r[-1]}" if len(r) > 1 else str(r[0]) for r in ranges)


def runs_table(cells: Sequence[CellResult]) -> str:
    """Steps, seeds and time of every cell."""
    rows = []
    for result in cells:
        cell, count = result.cell, result.count
        seconds = [float(run["seconds"]) for run in result.runs.values() if run["seconds"]]
        is_complete = len(result.runs) == len(cell.seeds)
        unfinished = f"; {result.unfinished} unfinished" if result.unfinished else ""
        rows.append(
            [
                result.title,
                ", ".join(filter(None, (cell.method, cell.label))),
                f"`{' '.join(cell.options)}`",
                f"{cell.steps:,}",
                (count if is_complete else f"**{count} planned**") + unfinished,
                in_ranges(result.runs),
                f"{statistics.median(seconds) / 60:.1f}" if seconds else "",
            ]
        )
    header = ("task", "method", "options", "steps", "runs", "seeds", "minutes a run (median)")
    return table(header, rows)


def search_table(cells: Sequence[CellResult]) -> str:
    """Settings, steps and seeds of every method on every task."""
    rows = []
    for group in groups_of(cells):
        cell = group[0].cell
        made = sum(len(result.runs) for result in group)
        planned = len(group) * len(cell.seeds)
        runs = f"{made}" if made == planned else f"**{made} of {planned} planned**"
        seeds = in_ranges({seed for result in group for seed in result.runs})
        rows.append([group[0].title, cell.method, len(group), f"{cell.steps:,}", runs, seeds])
    return table(("task", "method", "settings", "steps", "runs", "seeds"), rows)


def scores_table(cells: Sequence[CellResult]) -> str:
    """Scores of every cell that has runs."""
    rows = [
        [r.title, r.cell.method, *scores(r.count, r.scored, r.cell.task.solved)]
        for r in cells
        if r.scored is not None
    ]
    has_thresholds = any(r.cell.task.solved is not None for r in cells)
    width = 2 + len(SCORES) if has_thresholds else 2 + SCORES.index("solved")
    return table(("task", "method", *SCORES)[:width], [row[:width] for row in rows])


def solved_table(study: Study, cells: Sequence[CellResult]) -> str:
    """How many runs of each method solve each task, and the median of trajectories they need."""
    by_task: dict[str, dict[str, str]] = {}
    for r in cells:
        if r.scored is not None and r.cell.task.solved is not None:
            needed = steps_to_solve(*r.scored, r.cell.task.solved)
            solved = np.isfinite(needed)
            text = f"{solved.sum()} of {len(needed)}"
            median = f", {np.median(needed[solved]):,.0f}" if solved.any() else ""
            by_task.setdefault(r.title, {})[r.cell.method] = text + median
    methods = [name for name in study.methods if any(name in row for row in by_task.values())]
    if len(methods) < 4:  # few enough for the table of scores
        return ""
    rows = [[title, *(row.get(m, "") for m in methods)] for title, row in by_task.items()]
    return (
        "Runs that solve the task, and the median of the trajectories that these need:\n\n"
        + table(("task", *methods), rows)
    )


def scores(count: str, curve: Curve, threshold: float | None) -> list[str]:
    """What the columns `SCORES` say of some runs."""
    cells = [count, in_digits(area(*curve)), in_digits(final(*curve))]
    if threshold is None:
        return [*cells, "", ""]
    needed = steps_to_solve(*curve, threshold)
    median = np.median(needed)
    text = f"{median:,.0f}" if np.isfinite(median) else f"> {curve[0][-1]:,.0f}"
    return [*cells, f"{np.isfinite(needed).mean():.0%}", text]


def aggregates(study: Study, cells: Sequence[CellResult]) -> str:
    """Interquartile means and probabilities of improvement; empty if they make no sense yet."""
    finals = {(r.cell.task.name, r.cell.method): r.finals for r in cells}
    tasks = {
        r.cell.task.name: r
        for r in cells
        if all(len(finals[r.cell.task.name, method]) > 1 for method in study.methods)
    }
    if not tasks or len(study.methods) < 2:
        return ""
    units = {
        name: float(finals[name, study.scale_by].mean()) if study.scale_by else r.cell.task.best
        for name, r in tasks.items()
    }
    if None in units.values():
        return ""
    # One below 0 would turn the order round.
    units = {name: unit for name, unit in units.items() if unit is not None and unit > 0}
    if not units:
        return ""
    by_method = {}
    for method in study.methods:
        # As many runs of a method on each task as where it has fewest, the first seeds.
        count = min(len(finals[name, method]) for name in units)
        columns = [finals[name, method][:count] / unit for name, unit in units.items()]
        by_method[method] = np.stack(columns, axis=1)
    means, first = interquartile_means(by_method), next(iter(study.methods))
    better = probabilities_of_improvement(by_method, first)
    rows = [
        (m, len(by_method[m]), _interval(means[m]), _interval(better[m]) if m in better else "")
        for m in study.methods
    ]
    unit = f"the mean of {study.scale_by}" if study.scale_by else "the score of a perfect policy"
    titles = ", ".join(tasks[name].title for name in units)
    header = ("method", "runs a task", "IQM", f"probability that {first} is better")
    return (
        f"Final scores over {titles}, each in units of {unit}; of a method that has more runs on "
        "one task than on another, the first seeds:\n\n" + table(header, rows)
    )


def comparisons(study: Study, cells: Sequence[CellResult]) -> str:
    """How likely the first method is better than each other, on each task with runs to compare."""
    first, *others = study.methods
    compared = {(r.title, r.cell.method): r for r in cells if len(r.finals) > 1}
    rows = []
    for title in dict.fromkeys(result.title for result in cells):
        runs = {m: compared[title, m] for m in study.methods if (title, m) in compared}
        if first not in runs:
            continue
        by_area = {m: area(*r.scored)[:, None] for m, r in runs.items() if r.scored is not None}
        by_final = {m: r.finals[:, None] for m, r in runs.items()}
        better = [probabilities_of_improvement(scores, first) for scores in (by_area, by_final)]
        rows += [(title, m, *(_interval(b[m]) for b in better)) for m in others if m in runs]
    if not rows:
        return ""
    return table(("task", "other", f"{first} better by area", f"{first} better by final"), rows)


def _interval(estimate: Estimate) -> str:
    return f"{estimate.value:.2f} ({estimate.low:.2f} to {estimate.high:.2f})"


def ranking(study: Study, cells: Sequence[CellResult]) -> str:
    """The best settings of each method on each task."""
    score = {"area": area, "final": final}[study.rank_by]
    rows = []
    for group in groups_of(cells):
        scored = [(score(*result.scored), result) for result in group if result.scored]
        scored.sort(key=lambda pair: -pair[0].mean())
        best = [f"{r.cell.label}: {in_digits(s)} ({r.count} runs)" for s, r in scored[:BEST]]
        best += [""] * (BEST - len(best))
        searched = f"{len(scored)} of {len(group)}"
        rows.append([group[0].title, group[0].cell.method, searched, *best])
    headings = ("task", "method", "settings run", f"best {study.rank_by}", "second", "third")
    return table(headings, rows)


def groups_of(cells: Iterable[CellResult]) -> list[list[CellResult]]:
    """The settings of each method on each task."""
    groups: dict[tuple[str, str], list[CellResult]] = {}
    for result in cells:
        groups.setdefault((result.cell.task.name, result.cell.method), []).append(result)
    return list(groups.values())


# ----------------------------------------------------------------------------------------- figures


def draw(name: str, docs: Path, picture: Callable[[Path], object], text: str) -> str:
    """Draw a picture; return the markdown that shows it."""
    path = Path("figures", "study", f"{name}.svg")
    (docs / path).parent.mkdir(parents=True, exist_ok=True)
    picture(docs / path)
    return f"![{text}]({path})"


def curves_figure(
    study: Study, cells: Sequence[CellResult], docs: Path, metric: str | None = None
) -> str:
    """A panel for each task that has enough runs; of the task's own metric if none is named."""
    panels: dict[str, dict[str, Curve]] = {}
    for result in cells:
        curve = result.curve(metric) if metric else result.scored
        if curve is not None:
            panels.setdefault(result.title, {})[result.cell.method] = curve
    panels = {title: curves for title, curves in panels.items() if is_drawn(curves)}
    if not panels:
        return ""
    shown = [result for result in cells if result.title in panels]
    tasks = {result.title: result.cell.task for result in shown}
    levels = {
        title: {
            name: value
            for name, value in (("solved", task.solved), ("best possible", task.best))
            if value is not None and metric in (None, task.metric)
        }
        for title, task in tasks.items()
    }
    metrics = dict.fromkeys(metric or task.metric for task in tasks.values())
    y_label = " or ".join(METRIC_LABELS.get(name, name) for name in metrics)
    picture = partial(
        plot_comparison,
        panels,
        x_label=next(run["unit"] for result in shown for run in result.runs.values()),
        y_label=y_label,
        levels=levels,
    )
    name = f"{study.name}_{metric}" if metric else study.name
    return draw(name, docs, picture, f"{study.title}: {y_label}")


def is_drawn(curves: Mapping[str, Curve]) -> bool:
    """Whether a task has enough for a panel: half of the methods several runs, and no few dots."""
    several = [len(values) > 1 for _, values in curves.values()]
    points = [len(steps) for steps, _ in curves.values()]
    return sum(several) >= len(several) / 2 and min(points) >= FEW_POINTS


def heat_maps(study: Study, cells: Sequence[CellResult], docs: Path) -> str:
    """Final values over the grid of each method on each task."""
    return "\n\n".join(
        heat_map(study, group, docs, metric)
        for group in groups_of(cells)
        for metric in (group[0].cell.task.metric, *study.also)
        if any(result.curve(metric) is not None for result in group)
    )


@matplotlib.rc_context(STYLE)
def plot_heat_map(
    values: np.ndarray,
    path: Path,
    *,
    title: str,
    x_axis: tuple[str, Sequence[str]],
    y_axis: tuple[str, Sequence[str]],
) -> Path:
    """Draw a number for each pair of settings; return ``path``.

    Args:
        values: ``[y, x]``; NaN where there is none.
        path: of the picture; its ending is its format.
        title: of the picture.
        x_axis: name and settings of the columns.
        y_axis: name and settings of the rows.
    """
    size = (1.2 + 1.1 * len(x_axis[1]), 0.9 + 0.5 * len(y_axis[1]))
    figure = Figure(figsize=size, layout="constrained")
    panel = figure.subplots()
    panel.imshow(values, origin="lower", aspect="auto", cmap="viridis")
    panel.set_xticks(range(len(x_axis[1])), x_axis[1])
    panel.set_yticks(range(len(y_axis[1])), y_axis[1])
    panel.set(xlabel=symbols(x_axis[0]), ylabel=symbols(y_axis[0]), title=title)
    panel.spines[:].set_visible(False)
    brightest_with_white = np.nanmin(values) + 0.6 * np.ptp(values[np.isfinite(values)])
    for (row, column), value in np.ndenumerate(values):
        color = NEUTRAL if np.isnan(value) else "w" if value < brightest_with_white else "k"
        text = "not run" if np.isnan(value) else f"{value:.1f}"
        panel.text(column, row, text, ha="center", va="center", color=color)
    return save_figure(figure, path)


def heat_map(study: Study, group: Sequence[CellResult], docs: Path, metric: str) -> str:
    """Final values of a metric over a grid."""
    task, method = group[0].cell.task, group[0].cell.method
    axes = [
        (axis, list(dict.fromkeys(result.cell.setting[place][1] for result in group)))
        for place, (axis, _) in enumerate(group[0].cell.setting)
    ]
    shape = tuple(len(values) for _, values in axes)
    curves = [result.curve(metric) for result in group]
    means = [np.nan if curve is None else final(*curve).mean() for curve in curves]
    label = METRIC_LABELS.get(metric, metric)
    picture = partial(
        plot_heat_map,
        np.reshape(means, shape),
        title=f"{method} on {group[0].title}: final {label}",
        y_axis=axes[0],
        x_axis=axes[1],
    )
    suffix = "" if metric == task.metric else f"_{metric}"
    name = f"{study.name}_{task.name}_{method.lower()}{suffix}"
    return draw(name, docs, picture, f"{study.title}, {group[0].title}: final {label}")


# -------------------------------------------------------------------------------------------- page


def section(study: Study, cells: Sequence[CellResult], docs: Path) -> str:
    """All that is said of a study."""
    runs = runs_table(cells)
    if study.kind == "curves":
        parts = [
            curves_figure(study, cells, docs),
            solved_table(study, cells),
            scores_table(cells),
            comparisons(study, cells),
            aggregates(study, cells),
            *(curves_figure(study, cells, docs, metric) for metric in study.also),
        ]
    elif study.kind == "heat_map":
        parts = [heat_maps(study, cells, docs)]
    else:
        parts, runs = [ranking(study, cells)], search_table(cells)
    source = (
        f"The runs, by `make study ARGS='--only {study.name}'`; each with its time and versions, "
        "the curves and the whole configuration of each cell are in "
        f"[`results/study/{study.name}`](../sota-implementations/results/study/{study.name}):"
    )
    return "\n\n".join(filter(None, [f"## {study.title}", study.about, *parts, source, runs]))


def write_report(manifest: Manifest, results: Path, docs: Path) -> Path:
    """Write page and figures; return the page.

    Args:
        manifest: what was planned.
        results: the folder with what was collected.
        docs: where the page goes and, in ``figures/study``, its pictures.
    """
    sections, waiting = [], []
    for study in manifest.studies.values():
        cells = read_cells(manifest, study, results)
        if any(result.runs for result in cells):
            sections.append(section(study, cells, docs))
        else:
            waiting.append(f"- {study.title} (`{study.name}`)")
    if waiting:
        sections.append("## Without a complete run yet\n\n" + "\n".join(waiting))
    page = docs / "study.md"
    page.write_text("\n\n".join([INTRODUCTION.rstrip(), *sections]) + "\n")
    return page


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the report, and say where it is."""
    parser = argument_parser(__doc__)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--docs", type=Path, default=DOCS)
    options = parser.parse_args(arguments)
    try:
        manifest = read_manifests(options.manifest)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    print(write_report(manifest, options.results, options.docs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
