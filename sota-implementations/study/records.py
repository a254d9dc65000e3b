"""What the directory of a run says of it, whoever has made it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from manifest import Cell, changed_entries, identity, total_option
from omegaconf import DictConfig, OmegaConf

from torchrl_ecpo.experiment import read_metrics
from torchrl_ecpo.experiment.run import METRICS_FILE


@dataclass(frozen=True)
class Record:
    """A run, finished or not."""

    path: Path

    @cached_property
    def config(self) -> DictConfig:
        """Its whole configuration."""
        config = OmegaConf.load(self.path / "config.yaml")
        assert isinstance(config, DictConfig)
        return config

    @cached_property
    def identity(self) -> dict[str, float | str]:
        """All that determines its numbers."""
        return identity(self.config)

    def changes(self, cell: Cell, seed: int, ignored: Sequence[str] = ()) -> list[str]:
        """What differs from a run of a cell, in words; the stop too, if it stopped early."""
        changes = changed_entries(self.identity, cell.identity(seed), ignored)
        old, new = self.config.get("stop_when"), cell.config.get("stop_when")
        if self.stopped_at is not None and old != new and "stop_when" not in ignored:
            changes.append(f"stop_when was {old}, is {new}")
        return changes

    @property
    def seed(self) -> int:
        """Its seed."""
        return self.config.seed

    @property
    def unit(self) -> str:
        """What a step is: trajectories or frames."""
        return total_option(self.config).removeprefix("total_")

    @property
    def total(self) -> int:
        """How many steps it was to make."""
        return self.config[f"total_{self.unit}"]

    @cached_property
    def summary(self) -> dict[str, Any]:
        """What it left at its end; empty if it was killed, or goes on."""
        return _read_json(self.path / "summary.json")

    @property
    def seconds(self) -> float | None:
        """How long it took, of stacked runs its share; None before its end."""
        if "seconds" not in self.summary:
            return None
        return round(self.summary["seconds"] / self.summary.get("stack_size", 1), 1)

    @property
    def versions(self) -> dict[str, str]:
        """Of the packages it was made with, at last."""
        versions = _read_json(self.path / "versions.json")
        return {name: value for name, value in versions.items() if name != "earlier"}

    @property
    def stopped_at(self) -> int | None:
        """The step at which it stopped early, having reached what ``stop_when`` asks for."""
        is_early = bool(self.summary.get("finished")) and self.summary[self.unit] < self.total
        return self.summary[self.unit] if is_early and self.config.get("stop_when") else None

    @property
    def finished(self) -> bool:
        """Whether it has made all its steps; a summary may be that of a shorter run before it."""
        is_whole = bool(self.summary.get("finished")) and self.summary[self.unit] >= self.total
        return is_whole or self.stopped_at is not None

    @cached_property
    def metrics(self) -> dict[str, list[float]]:
        """Its record: a column for each metric."""
        return read_metrics(self.path)

    @property
    def reached(self) -> int:
        """How many steps it has made, as far as they are recorded; all, if it stopped early."""
        if self.stopped_at is not None:
            return self.total
        if self.finished:
            return self.summary[self.unit]
        return int(self.metrics["step"][-1]) if self.metrics else 0


def find_record(directory: Path) -> Record | None:
    """The run in a directory, if one has begun there."""
    files = (directory / "config.yaml", directory / METRICS_FILE)
    return Record(directory) if all(file.is_file() for file in files) else None


def find_records(bases: list[Path]) -> Iterator[Record]:
    """The runs at or below some directories, in order.

    Raises:
        FileNotFoundError: if one of the directories does not exist.
    """
    for base in bases:
        if not base.is_dir():
            raise FileNotFoundError(f"There is no directory {base}.")
        for file in sorted(base.rglob("config.yaml")):
            record = find_record(file.parent)
            if record is not None:
                yield record


def _read_json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text()) if path.is_file() else {}
