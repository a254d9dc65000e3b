"""What is committed of a study: its runs, their curves, each cell's configuration; its reader."""

from __future__ import annotations

import csv
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from manifest import SCRIPTS, Cell, Manifest, Study, changed_entries, present
from records import Record

from torchrl_ecpo.experiment.compare import Curve, align, final

RESULTS = SCRIPTS / "results"
# Of a curve: each is the mean over a hundredth of the run.
POINTS = 100
KEYS = ("task", "method", "setting", "seed")
Key = tuple[str, str, str, int]
Point = dict[str, float]


@dataclass
class Results:
    """Results of a study, by task, method, setting and seed.

    Three files: ``runs.csv`` has a row for each run, with options, steps, time and versions,
    ``curves.csv`` the metrics, ``configs.json`` the whole configuration of each cell.
    """

    directory: Path
    runs: dict[Key, dict[str, str]] = field(default_factory=dict)
    curves: dict[Key, list[Point]] = field(default_factory=dict)
    configs: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def read(cls, directory: Path) -> Results:
        """Read what is committed; empty if there is nothing."""
        if not directory.is_dir():
            return cls(directory)
        runs = {_key(row): row for row in _read_csv(directory / "runs.csv")}
        points = _read_csv(directory / "curves.csv")
        curves = {
            key: [_point(row) for row in rows] for key, rows in itertools.groupby(points, _key)
        }
        configs = json.loads((directory / "configs.json").read_text())
        return cls(directory, runs, curves, {present(cell): own for cell, own in configs.items()})

    def write(self) -> None:
        """Write the files, in an order that depends on nothing but their content."""
        self.directory.mkdir(parents=True, exist_ok=True)
        _write_csv(self.directory / "runs.csv", [self.runs[key] for key in sorted(self.runs)])
        points = [
            {**dict(zip(KEYS, key, strict=True)), **point}
            for key in sorted(self.curves)
            for point in self.curves[key]
        ]
        _write_csv(self.directory / "curves.csv", points)
        text = json.dumps(self.configs, indent=1, sort_keys=True)
        (self.directory / "configs.json").write_text(text + "\n")

    def add(
        self, cell: Cell, record: Record, metrics: Sequence[str], ignored: Sequence[str] = ()
    ) -> bool:
        """Take a run in, unless one of the cell and seed is there that went as far.

        One that went as far replaces it if it has more of the metrics, or if the curve that is
        there is that of a longer cell, and coarser.

        Runs of the cell that were made with another configuration are dropped, but for entries
        that are ignored.
        """
        config = _but_for_the_seed(record.identity)
        changes = changed_entries(self.configs.get(cell.name, config), config, ignored)
        if changes:
            print(
                f"{self.directory.name}: results of {cell.name} are dropped, for "
                f"{'; '.join(changes)}"
            )
            self._drop(cell)
        key = (cell.task.name, cell.method, cell.label, record.seed)
        curve = thin(record.metrics, metrics, cell.steps)
        if key in self.runs:
            old = self.runs[key]
            further = min(record.reached, cell.steps) - min(recorded(old), cell.steps)
            has_more = _names(curve) > _names(self.curves.get(key, []))
            is_finer = cell.steps < int(old["steps"])
            if further < 0 or (further == 0 and not (has_more or is_finer)):
                return False
        self.configs[cell.name] = config
        self.curves[key] = curve
        if record.stopped_at is not None:
            self.curves[key] = extended(self.curves[key], cell.steps)
        values = {
            **dict(zip(KEYS, key, strict=True)),
            "options": " ".join(cell.options),
            "steps": cell.steps,
            "reached": record.reached,
            "unit": record.unit,
            "finished": record.finished,
            "stopped_at": record.stopped_at or "",
            "seconds": "" if record.seconds is None else record.seconds,
            **record.versions,
        }
        self.runs[key] = {name: str(value) for name, value in values.items()}
        return True

    def has(self, cell: Cell, seed: int, ignored: Sequence[str] = ()) -> bool:
        """Whether a run of the cell as it is now is there, with all its steps."""
        run = self.runs.get((cell.task.name, cell.method, cell.label, seed))
        if run is None or recorded(run) < cell.steps:
            return False
        config = _but_for_the_seed(cell.identity(seed))
        return not changed_entries(self.configs[cell.name], config, ignored)

    def _drop(self, cell: Cell) -> None:
        for key in list(self.runs):
            if key[:3] == (cell.task.name, cell.method, cell.label):
                del self.runs[key]
                self.curves.pop(key, None)  # none, of a run that was killed before its first point


def recorded(run: Mapping[str, str]) -> int:
    """Up to which step the curve of a run goes: no further than its cell did when it was taken."""
    return min(int(run["reached"]), int(run["steps"]))


@dataclass(frozen=True)
class CellResult:
    """What is known of a cell."""

    cell: Cell
    runs: dict[int, dict[str, str]]
    """By seed, of those planned: the runs that made all steps."""
    unfinished: int
    """Runs that did not."""
    curves: dict[int, list[Point]]

    @property
    def title(self) -> str:
        """Of the task."""
        return self.cell.task.title or self.cell.task.name

    @property
    def count(self) -> str:
        """Runs that there are; of how many, if there should be more."""
        planned = len(self.cell.seeds)
        return (
            f"{len(self.runs)}" if len(self.runs) == planned else f"{len(self.runs)} of {planned}"
        )

    def curve(self, metric: str) -> Curve | None:
        """None if no run has the metric."""
        points = [
            [(point["step"], point[metric]) for point in self.curves[seed] if metric in point]
            for seed in sorted(self.runs)
        ]
        measured = [np.array(pairs) for pairs in points if pairs]
        return align(measured, self.cell.name) if measured else None

    @cached_property
    def scored(self) -> Curve | None:
        """The task's own metric."""
        return self.curve(self.cell.task.metric)

    @cached_property
    def finals(self) -> np.ndarray:
        """The final score of each run, ``[runs]``."""
        return np.empty(0) if self.scored is None else final(*self.scored)


def read_cells(manifest: Manifest, study: Study, results: Path = RESULTS) -> list[CellResult]:
    """What was collected of a study in a folder of results."""
    collected = Results.read(results / "study" / study.name)
    return [read_cell(cell, collected) for cell in manifest.cells(study)]


def read_cell(cell: Cell, results: Results) -> CellResult:
    """The results of a cell; a run with other options than the cell's now is none of it."""
    options, complete, unfinished = present(" ".join(cell.options)), {}, 0
    curves = {}
    for seed in cell.seeds:
        key = (cell.task.name, cell.method, cell.label, seed)
        run = results.runs.get(key)
        if run is None or present(run["options"]) != options:
            continue
        if recorded(run) < cell.steps:
            unfinished += 1
            continue
        complete[seed] = run
        points = results.curves.get(key, [])  # none, if nothing was ever measured
        curves[seed] = [point for point in points if point["step"] <= cell.steps]
    return CellResult(cell, complete, unfinished, curves)


def thin(columns: Mapping[str, Sequence[float]], metrics: Sequence[str], steps: int) -> list[Point]:
    """The mean of each metric over each of `POINTS` equal parts of a run, where it was measured.

    Args:
        columns: of ``metrics.csv``.
        metrics: to be kept, of those that are there.
        steps: of the run; what is later is left out. A part has the number of its last step.

    Examples:
        >>> thin({"step": [1, 2, 3], "return": [0.0, 2.0, 5.0]}, ["return"], steps=200)
        [{'step': 2, 'return': 1.0}, {'step': 4, 'return': 5.0}]
    """
    at = np.array(columns.get("step", ()))
    width = steps / POINTS
    # Rounding errors must not put the last step of a part into the next.
    parts = np.maximum(np.ceil(at / width - 1e-9), 1)
    parts[at > steps] = np.nan
    points: list[Point] = []
    for part in np.unique(parts[np.isfinite(parts)]):
        point: Point = {"step": round(part * width)}
        for name in metrics:
            values = np.array(columns[name])[parts == part] if name in columns else np.empty(0)
            values = values[np.isfinite(values)]
            if len(values):
                point[name] = float(f"{values.mean():.5g}")
        if len(point) > 1:
            points.append(point)
    return points


def extended(points: Sequence[Point], steps: int) -> list[Point]:
    """The curve of a run that stopped early, with what it held until the end.

    Examples:
        >>> extended([{"step": 198, "return": 5.0}], steps=200)
        [{'step': 198, 'return': 5.0}, {'step': 200, 'return': 5.0}]
    """
    last = {name: value for point in points for name, value in point.items()}
    ends = [round(part * steps / POINTS) for part in range(1, POINTS + 1)]
    return [*points, *({**last, "step": end} for end in ends if end > last["step"])]


def _but_for_the_seed(identity: Mapping[str, float | str]) -> dict[str, float | str]:
    """What the runs of a cell share; the bandit's instance is named after the seed too."""
    return {name: value for name, value in identity.items() if not name.endswith("seed")}


def _names(points: Sequence[Point]) -> set[str]:
    return {name for point in points for name in point}


def _key(row: Mapping[str, str]) -> Key:
    return row["task"], row["method"], present(row["setting"]), int(row["seed"])


def _point(row: Mapping[str, str]) -> Point:
    metrics = {k: float(v) for k, v in row.items() if k not in (*KEYS, "step") and v}
    return {"step": int(row["step"]), **metrics}


def _read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    columns = dict.fromkeys(name for row in rows for name in row)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
