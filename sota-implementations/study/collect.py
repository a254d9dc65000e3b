"""Take the results of runs into few small files, which are committed.

``python collect.py runs/study [other directories]``. A run belongs to a cell of the manifest if its
configuration is the cell's; who has started it, and where, does not matter. Results that are there
already stay, unless a run comes that went further or the cell's configuration has changed.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from manifest import (
    Cell,
    add_ignored,
    add_studies,
    argument_parser,
    changed_entries,
    read_manifests,
)
from records import Record, find_records
from results import RESULTS, Results


def is_of(cell: Cell, record: Record, ignored: Sequence[str]) -> bool:
    """Whether a run is one of a cell."""
    if record.seed not in cell.seeds or cell.total_option != f"total_{record.unit}":
        return False
    return not record.changes(cell, record.seed, ignored)


def nearest(record: Record, cells: Iterable[Cell]) -> str:
    """The cell to which a run comes closest, and what differs, in words."""
    compared = [
        (changed_entries(cell.identity(record.seed), record.identity), cell)
        for cell in cells
        if cell.total_option == f"total_{record.unit}"
    ]
    if not compared:
        return "no cell is of its script"
    changes, cell = min(compared, key=lambda pair: len(pair[0]))
    changes = changes or record.changes(cell, record.seed)
    changes = changes or [f"seed {record.seed} is not among the planned"]
    return f"nearest is {cell.name}, but {'; '.join(changes)}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Collect, and say what was found; return the exit status."""
    parser = argument_parser(__doc__)
    add_studies(parser)
    add_ignored(parser)
    parser.add_argument("directories", nargs="*", type=Path, default=[Path("runs/study")])
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--unmatched", action="store_true", help="say what other runs there are")
    options = parser.parse_args(arguments)
    try:
        manifest = read_manifests(options.manifest)
        cells = manifest.select(options.only)
        records = list(find_records(options.directories))
    except (ValueError, OSError) as error:
        parser.error(str(error))
    names = dict.fromkeys(cell.study for cell in cells)
    results = {name: Results.read(options.results / "study" / name) for name in names}
    added, others = dict.fromkeys(names, 0), 0
    unread = 0
    for record in records:
        try:
            matching = [cell for cell in cells if is_of(cell, record, options.ignore)]
            for cell in matching:
                metrics = [cell.task.metric, *manifest.studies[cell.study].also]
                added[cell.study] += results[cell.study].add(cell, record, metrics, options.ignore)
            if not matching:
                others += 1
                if options.unmatched:
                    print(f"{record.path}: {nearest(record, cells)}")
        except Exception as error:  # whatever a torn or a strange file raises: the others count
            print(f"{record.path} is left out: {type(error).__name__}: {error}")
            unread += 1
    for name, result in results.items():
        if result.runs:
            result.write()
            print(f"{name}: {added[name]} runs taken in, {len(result.runs)} in all")
    print(f"{others} of {len(records)} runs are in no cell{' (--unmatched)' if others else ''}")
    return int(unread > 0)


if __name__ == "__main__":
    sys.exit(main())
