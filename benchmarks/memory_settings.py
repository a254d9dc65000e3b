"""What glibc's memory settings change: updates of the actor-critics with and without them.

    python benchmarks/memory_settings.py --csv memory_settings.csv

By default the C library hands freed memory back to the system, and the next update asks for it
again, page by page. `SETTINGS` keep it. They are read when a process starts, so that each turn is a
process of its own; figures are medians over the turns of the medians of processor time within one.
The updates are those of `actor_critic.py`: one thread, HalfCheetah-v5, two layers of 256 units,
batches of 256.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from statistics import median

import torch
from actor_critic import configure, update
from csv_table import add_csv_option, write_csv

SETTINGS = {
    "MALLOC_TRIM_THRESHOLD_": "10000000000",
    "MALLOC_MMAP_THRESHOLD_": "1000000000",
    "MALLOC_TOP_PAD_": "64000000",
}
KINDS: dict[str, dict[str, str]] = {"default": {}, "kept": SETTINGS}
METHODS = ("sac", "ecac")


def measure(method: str, iterations: int) -> dict[str, float]:
    """Milliseconds and page faults of an update in this process."""
    iterate = update(configure([f"loss={method}"]))
    iterate()
    times, faults = [], []
    for _ in range(iterations):
        start, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        updates = iterate()
        times.append((time.process_time() - start) / updates * 1e3)
        after = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        faults.append((after - before) / updates)
    return {"ms": median(times), "page_faults": median(faults)}


def measure_in_turn(settings: dict[str, str], iterations: int) -> dict[str, dict[str, float]]:
    """The figures of each method, from a process with these settings."""
    others = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    command = [sys.executable, __file__, "--iterations", str(iterations), "--here"]
    output = subprocess.check_output(command, env={**others, **settings}, text=True)
    return json.loads(output.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--repeats", type=int, default=3, help="processes of each kind")
    parser.add_argument("--iterations", type=int, default=20, help="of ten updates, in a process")
    parser.add_argument("--here", action="store_true", help="measure in this process alone")
    add_csv_option(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.here:
        print(json.dumps({method: measure(method, options.iterations) for method in METHODS}))
        return
    turns = [
        {kind: measure_in_turn(kept, options.iterations) for kind, kept in KINDS.items()}
        for _ in range(options.repeats)
    ]
    rows = []
    for method in METHODS:
        row: dict[str, object] = {"method": method}
        for kind in KINDS:
            for figure in ("ms", "page_faults"):
                row[f"{figure}_{kind}"] = median(turn[kind][method][figure] for turn in turns)
        ratios = [turn["kept"][method]["ms"] / turn["default"][method]["ms"] for turn in turns]
        row |= {"kept_over_default": median(ratios), "lowest": min(ratios), "highest": max(ratios)}
        rows.append(row)
        print(row)
    write_csv(options.csv, rows)


if __name__ == "__main__":
    main()
