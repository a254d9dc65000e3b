"""What the benchmarks share: options, and a table as a file."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch


def read_arguments(doc: str | None, **defaults: object) -> argparse.Namespace:
    """Options of a benchmark, of the types of their defaults, and `--csv PATH`; one thread.

    A count must be at least 1, as there is no median of none.

    Args:
        doc: of the benchmark; its first line is the help.
        defaults: of the options; one whose default is a list takes several values.
    """
    parser = argparse.ArgumentParser(description=(doc or "").split("\n")[0])
    for name, default in defaults.items():
        option = "--" + name.replace("_", "-")
        if isinstance(default, bool):
            parser.add_argument(option, action="store_true")
        elif isinstance(default, list):
            kind = type(default[0])
            parser.add_argument(option, type=kind, nargs="+", default=default, help=f"{default}")
        else:
            parser.add_argument(option, type=type(default), default=default, help=f"{default}")
    parser.add_argument("--csv", type=Path, metavar="PATH", help="also write the table here")
    torch.set_num_threads(1)
    arguments = parser.parse_args()
    for name, value in vars(arguments).items():
        if type(value) is int and value < 1:
            parser.error(f"--{name.replace('_', '-')} must be at least 1, got {value}")
    return arguments


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
