"""What the benchmarks share: a table as a file."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable, Mapping
from pathlib import Path


def add_csv_option(parser: argparse.ArgumentParser) -> None:
    """Let `--csv PATH` say where the table goes, besides the terminal."""
    parser.add_argument("--csv", type=Path, metavar="PATH", help="also write the table here")


def write_csv(path: Path | None, rows: Iterable[Mapping[str, object]]) -> None:
    """Write rows with equal columns; floats with four digits. Without a path, nothing."""
    if path is None:
        return
    table = [
        {name: f"{x:.4g}" if isinstance(x, float) else x for name, x in row.items()} for row in rows
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
