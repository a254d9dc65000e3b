"""Compare runs: a table and a picture with a curve for each method.

``python -m torchrl_ecpo.experiment.compare RUN_DIRECTORY... --metric expected_reward``
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from torchrl_ecpo.experiment.figures import plot_comparison, smooth
from torchrl_ecpo.experiment.run import METRICS_FILE, read_metrics

__all__ = ["Comparison", "find_runs", "load_comparison", "main"]


@dataclass(frozen=True)
class Comparison:
    """Runs of several methods on one task, on common steps."""

    metric: str
    curves: dict[str, tuple[np.ndarray, np.ndarray]]
    """By method, the steps ``[n]`` and the values ``[runs, n]``."""

    def write(self, path: Path) -> Path:
        """Write all curves as one csv table with a row for each point of each run."""
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["method", "run", "step", self.metric])
            for method, (steps, runs) in self.curves.items():
                for run, values in enumerate(runs):
                    for step, value in zip(steps, values, strict=True):
                        writer.writerow([method, run, round(step), f"{value:.6g}"])
        return path

    def table(self) -> str:
        """Final value of each method as a markdown table: mean, standard error, worst, runs."""
        lines = [f"| method | runs | steps | {self.metric} | worst |", "|---|---|---|---|---|"]
        for method, (steps, values) in self.curves.items():
            final = values[:, -1]
            error = final.std(ddof=1) / np.sqrt(len(final)) if len(final) > 1 else np.nan
            spread = "" if np.isnan(error) else f" ± {error:.3f}"
            lines.append(
                f"| {method} | {len(final)} | {int(steps[-1]):,} | {final.mean():.3f}{spread} "
                f"| {final.min():.3f} |"
            )
        return "\n".join(lines)


def find_runs(directories: Sequence[Path]) -> list[Path]:
    """Directories of runs at or below the given ones, in order.

    Raises:
        FileNotFoundError: if there is none.
    """
    runs = sorted({path.parent for top in directories for path in top.rglob(METRICS_FILE)})
    if not runs:
        names = ", ".join(map(str, directories))
        raise FileNotFoundError(f"There is no run (a folder with {METRICS_FILE}) below {names}.")
    return runs


def load_comparison(
    runs: Sequence[Path],
    metric: str,
    *,
    by: Sequence[str] = ("loss.name",),
    smoothing: float = 0.0,
    points: int = 200,
) -> Comparison:
    """Read runs and put the curves of each method on common steps.

    Args:
        runs: directories of runs.
        metric: the column to compare.
        by: the entries of ``config.yaml`` that tell methods apart.
        smoothing: length of the trailing window over which values are averaged, as a fraction of
            the run; by default they are taken as measured.
        points: how many steps a curve has; a value is the latest one at or before the step.

    Raises:
        KeyError: if a run has no such metric or entry.
    """
    curves: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for run in runs:
        columns = read_metrics(run)
        if metric not in columns:
            raise KeyError(f"{run} has no metric {metric!r}; it has {sorted(columns)}.")
        method = _method(run, by)
        steps, values = np.array(columns["step"]), np.array(columns[metric])
        measured = ~np.isnan(values)
        if not measured.any():
            raise ValueError(f"{run} has no value of {metric!r} yet: leave it out, or wait.")
        curves.setdefault(method, []).append((steps[measured], smooth(values[measured], smoothing)))
    common: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for method, pairs in curves.items():
        first = max(steps[0] for steps, _ in pairs)
        last = min(steps[-1] for steps, _ in pairs)
        if first > last:
            raise ValueError(
                f"The runs of {method} have no steps in common: one ends at {last:,.0f}, another "
                f"begins at {first:,.0f}. Compare runs that overlap."
            )
        grid = np.linspace(last, first, points)[::-1]  # the last step, if there is only one point
        values = [v[np.searchsorted(steps, grid, side="right") - 1] for steps, v in pairs]
        common[method] = (grid, np.stack(values))
    return Comparison(metric, common)


def _method(run: Path, by: Sequence[str]) -> str:
    config = OmegaConf.load(run / "config.yaml")
    absent = object()
    values = [OmegaConf.select(config, entry, default=absent) for entry in by]
    if absent in values:
        missing = by[values.index(absent)]
        raise KeyError(f"The config.yaml of {run} has no entry {missing!r} to tell methods apart.")
    first, *others = ("null" if value is None else str(value) for value in values)
    return ", ".join([first, *(f"{e} {v}" for e, v in zip(by[1:], others, strict=True))])


def _is_unfinished(run: Path) -> bool:
    summary = run / "summary.json"  # which a run that was killed has not written
    return not summary.is_file() or not json.loads(summary.read_text())["finished"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table of a comparison, and where its picture is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directories", nargs="+", type=Path, help="runs, or folders of runs")
    parser.add_argument("--metric", required=True, help="column of metrics.csv to compare")
    parser.add_argument(
        "--by", nargs="+", default=["loss.name"], help="config entries that tell methods apart"
    )
    parser.add_argument("--points", type=int, default=200, help="of a curve")
    parser.add_argument("--smoothing", type=float, default=0.0, help="as a fraction of the run")
    parser.add_argument("--title", default="")
    parser.add_argument("--x-label", default="trajectories")
    parser.add_argument("--output", type=Path, help="picture; by default beside the runs")
    parser.add_argument("--csv", type=Path, help="also write the curves as a csv table")
    options = parser.parse_args(arguments)
    runs = find_runs(options.directories)
    comparison = load_comparison(
        runs,
        options.metric,
        by=options.by,
        smoothing=options.smoothing,
        points=options.points,
    )
    print(comparison.table())
    for run in filter(_is_unfinished, runs):
        print(f"not finished, and curves are as long as the shortest one: {run}")
    if options.csv is not None:
        print(f"curves: {comparison.write(options.csv).resolve()}")
    picture = plot_comparison(
        comparison.curves,
        options.output or options.directories[0] / "comparison.png",
        title=options.title,
        x_label=options.x_label,
        y_label=options.metric,
    )
    print(f"picture: {picture.resolve()}")


if __name__ == "__main__":
    main()
