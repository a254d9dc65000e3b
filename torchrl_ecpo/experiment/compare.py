"""Compare runs: a table and a picture with a curve for each method.

``python -m torchrl_ecpo.experiment.compare RUN_DIRECTORY...``
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from torchrl_ecpo.experiment.figures import plot_comparison, smooth
from torchrl_ecpo.experiment.options import flatten
from torchrl_ecpo.experiment.run import METRICS_FILE, read_metrics

__all__ = ["Comparison", "align", "area", "final", "find_runs", "load_comparison", "main"]

DEFAULT_METRICS = ("evaluation_return", "expected_reward", "return")
Curve = tuple[np.ndarray, np.ndarray]
"""Steps ``[n]`` and values ``[runs, n]``."""


@dataclass(frozen=True)
class Comparison:
    """Runs of several methods on one task, on common steps.

    Examples:
        >>> steps = np.array([0.0, 10.0, 20.0])
        >>> runs = np.array([[1.0, 2.0, 3.0], [1.0, 4.0, 5.0]])
        >>> print(Comparison("return", {"ecpo": (steps, runs)}).table().splitlines()[-1])
        | ecpo | 2 | 20 | 2.750 ± 0.750 | 4.000 ± 1.000 | 3.000 |
    """

    metric: str
    curves: dict[str, Curve]
    """By method."""

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
        """Scores of each method as a markdown table, the best first.

        Methods are ranked by the mean of the metric over the run (:func:`area`). Beside it are the
        mean of its last tenth (:func:`final`), both with standard error over runs, and the worst
        run's.
        """
        lines = [
            f"| method | runs | steps | mean {self.metric} | final {self.metric} | worst |",
            "|---|---|---|---|---|---|",
        ]
        for method in sorted(self.curves, key=lambda method: -area(*self.curves[method]).mean()):
            steps, values = self.curves[method]
            means, ends = area(steps, values), final(steps, values)
            lines.append(
                f"| {method} | {len(ends)} | {int(steps[-1]):,} | {with_error(means)} "
                f"| {with_error(ends)} | {ends.min():.3f} |"
            )
        return "\n".join(lines)


def area(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean of the metric over the run, ``[runs]``: the area under the curve over its length.

    Values ``[runs, n]``, at steps ``[n]``, are joined by straight lines.

    Examples:
        >>> area(np.array([0, 10, 40]), np.array([[0.0, 2.0, 4.0]])).tolist()
        [2.5]
    """
    if len(steps) == 1:
        return values[:, 0]
    means = (values[:, 1:] + values[:, :-1]) / 2
    return means @ np.diff(steps) / (steps[-1] - steps[0])


def final(steps: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean of values ``[runs, n]`` over the last tenth of the steps ``[n]``: ``[runs]``.

    Examples:
        >>> final(np.array([10, 90, 95, 100]), np.array([[0.0, 1.0, 2.0, 4.0]])).tolist()
        [3.0]
    """
    is_late = (steps > 0.9 * steps[-1]) | (steps == steps[-1])
    return values[:, is_late].mean(axis=1)


def with_error(values: np.ndarray, spec: str = ".3f") -> str:
    """Mean and standard error, of several values, in a format.

    Examples:
        >>> with_error(np.array([10.0, 14.0]), ".1f")
        '12.0 ± 2.0'
    """
    error = f" ± {values.std(ddof=1) / np.sqrt(len(values)):{spec}}" if len(values) > 1 else ""
    return f"{values.mean():{spec}}{error}"


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
    metric: str | None = None,
    *,
    by: Sequence[str] = ("loss.name",),
    smoothing: float = 0.0,
) -> Comparison:
    """Read runs and put the curves of each method on common steps.

    A run that ended once it had solved its task (``stop_when``) keeps its last value.

    Args:
        runs: directories of runs.
        metric: the column to compare; None: the first of ``evaluation_return``,
            ``expected_reward`` and ``return`` that the first run has.
        by: the entries of ``config.yaml`` that tell methods apart.
        smoothing: length of the trailing window over which values are averaged, as a fraction of
            the run; by default they are taken as measured.

    Raises:
        FileNotFoundError: if a run has no ``config.yaml``.
        KeyError: if a run has no such metric or entry.
        ValueError: if a run has no value yet, if the runs of a method do not overlap, are of
            several tasks, or have a seed twice.
    """
    if metric is None:
        measured = read_metrics(runs[0])
        metric = next((name for name in DEFAULT_METRICS if name in measured), DEFAULT_METRICS[-1])
    curves: dict[str, list[np.ndarray]] = {}
    members: dict[str, list[tuple[Path, Any]]] = {}  # by method, runs and their configurations
    for run in runs:
        columns = read_metrics(run)
        if metric not in [*columns]:
            raise KeyError(f"{run} has no metric {metric!r}; it has {sorted(columns)}.")
        config = _config(run)
        method = _method(run, config, by)
        members.setdefault(method, []).append((run, config))
        steps, values = np.array(columns["step"]), np.array(columns[metric])
        measured = ~np.isnan(values)
        if not measured.any():
            raise ValueError(f"{run} has no value of {metric!r} yet: leave it out, or wait.")
        curve = np.stack([steps[measured], smooth(values[measured], smoothing)], axis=1)
        curves.setdefault(method, []).append(_extended(curve, run, config))
    for method, own in members.items():
        _check_alike(method, own)
    return Comparison(metric, {method: align(curves[method], method) for method in curves})


def align(curves: Sequence[np.ndarray], method: str) -> Curve:
    """Put runs on the steps at which any was measured; each keeps its latest value in between.

    Args:
        curves: of each run ``[n, 2]``, steps and values; n may differ.
        method: whose runs they are, for the message.

    Raises:
        ValueError: if one run begins after another ends.

    Examples:
        >>> one, other = np.array([[1, 5.0], [3, 6.0]]), np.array([[2, 7.0], [4, 8.0]])
        >>> steps, values = align([one, other], "ECPO")
        >>> steps.tolist(), values.tolist()
        ([2.0, 3.0], [[5.0, 6.0], [7.0, 7.0]])
    """
    first, last = max(c[0, 0] for c in curves), min(c[-1, 0] for c in curves)
    if first > last:
        raise ValueError(
            f"The runs of {method} have no steps in common: one ends at {last:,.0f}, another "
            f"begins at {first:,.0f}. Compare runs that overlap."
        )
    steps = np.unique(np.concatenate([curve[:, 0] for curve in curves]))
    steps = steps[(first <= steps) & (steps <= last)]
    values = [c[np.searchsorted(c[:, 0], steps, side="right") - 1, 1] for c in curves]
    return steps, np.stack(values)


def _extended(curve: np.ndarray, run: Path, config: Any) -> np.ndarray:
    """With what a run that ended once it had solved its task (``stop_when``) kept until the end."""
    total = next((config[name] for name in config if str(name).startswith("total_")), 0)
    summary = run / "summary.json"
    if not config.get("stop_when") or curve[-1, 0] >= total or not summary.is_file():
        return curve
    is_finished = json.loads(summary.read_text()).get("finished")
    return np.vstack([curve, [total, curve[-1, 1]]]) if is_finished else curve


def _config(run: Path) -> Any:
    if not (run / "config.yaml").is_file():
        raise FileNotFoundError(f"There is no config.yaml in {run}: is it the directory of a run?")
    return OmegaConf.load(run / "config.yaml")


def _check_alike(method: str, members: Sequence[tuple[Path, Any]]) -> None:
    """Refuse the mean of runs that are not of one method: on another task, or with a seed twice."""
    first, config = members[0]
    task = _task(config)
    by_seed: dict[Any, Path] = {}
    for run, config in members:
        if _task(config) != task:
            raise ValueError(
                f"{method} has runs on several tasks, {first} and {run}. Compare one task at a "
                "time, or name what tells them apart: --by loss.name env.name."
            )
        seed = OmegaConf.select(config, "seed")
        if seed is not None and seed in by_seed:
            raise ValueError(
                f"{method} has the seed {seed} twice, in {by_seed[seed]} and {run}. Leave one out, "
                "or name the options that tell the runs apart: --by loss.name optim.lr."
            )
        by_seed[seed] = run


def _task(config: Any) -> dict[str, Any]:
    """What says which task a run is on, but for the problem instances, which may be a seed's."""
    entries = flatten({"env": OmegaConf.select(config, "env")})
    return {name: value for name, value in entries.items() if not name.endswith("seed")}


def _method(run: Path, config: Any, by: Sequence[str]) -> str:
    absent = object()
    values = [OmegaConf.select(config, entry, default=absent) for entry in by]
    if absent in values:
        missing = by[values.index(absent)]
        raise KeyError(f"The config.yaml of {run} has no entry {missing!r} to tell methods apart.")
    first, *others = ("null" if value is None else str(value) for value in values)
    return ", ".join([first, *(f"{e} {v}" for e, v in zip(by[1:], others, strict=True))])


def _unit(run: Path) -> str:
    """What a step is: the length of a run is ``total_trajectories``, ``total_frames``, ..."""
    names = map(str, OmegaConf.load(run / "config.yaml"))
    return next((n.removeprefix("total_") for n in names if n.startswith("total_")), "steps")


def _is_unfinished(run: Path) -> bool:
    with suppress(FileNotFoundError, ValueError):  # what a run that was killed has not written
        return not json.loads((run / "summary.json").read_text())["finished"]
    return True


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table of a comparison, and where its picture is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directories", nargs="+", type=Path, help="runs, or folders of runs")
    parser.add_argument(
        "--metric",
        help="column of metrics.csv; by default the first that the first run has of "
        + ", ".join(DEFAULT_METRICS),
    )
    parser.add_argument(
        "--by", nargs="+", default=["loss.name"], help="config entries that tell methods apart"
    )
    parser.add_argument("--smoothing", type=float, default=0.0, help="as a fraction of the run")
    parser.add_argument("--title", default="")
    parser.add_argument("--x-label", help="by default what a step of the first run is")
    parser.add_argument("--output", type=Path, help="picture; by default beside the runs")
    parser.add_argument("--csv", type=Path, help="also write the curves as a csv table")
    options = parser.parse_args(arguments)
    try:
        runs = find_runs(options.directories)
        comparison = load_comparison(
            runs, options.metric, by=options.by, smoothing=options.smoothing
        )
        print(comparison.table())
        for run in filter(_is_unfinished, runs):
            print(f"not finished, and curves are as long as the shortest one: {run}")
        if options.csv is not None:
            print(f"curves: {comparison.write(options.csv).resolve()}")
        picture = plot_comparison(
            {options.title: comparison.curves},
            options.output or options.directories[0] / "comparison.png",
            x_label=options.x_label or _unit(runs[0]),
            y_label=comparison.metric,
        )
        print(f"picture: {picture.resolve()}")
    except (OSError, KeyError, ValueError) as error:
        # A KeyError in words has quotes; the first argument of a system's error is its number.
        parser.error(error.args[0] if isinstance(error, KeyError) else str(error))


if __name__ == "__main__":
    main()
