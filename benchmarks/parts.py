"""Where the time of the two scripts goes: the parts of an iteration.

    python benchmarks/parts.py --csv parts.csv

One thread, one process, median processor time in milliseconds.

- ecpo: Reverse at level 10, as `benchmarks/loop.py` has it: 40 groups of 10 trajectories, of a
  policy biased so that they last.
- ecac, sac: HalfCheetah-v5 with the script's defaults; a frame and an update.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from actor_critic import configure, make_data, make_parts
from common import read_arguments, write_csv
from ecac import total  # pyright: ignore[reportMissingImports]
from loop import MAX_GRAD_NORM, PROJECT_STEPS, make_actor, make_ecpo
from torch.nn.utils import clip_grad_norm_

LEVEL, NUM_GROUPS = 10, 40


class Stopwatch:
    """Processor time of the parts of an iteration."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, part: str) -> Iterator[None]:
        """Add the time spent inside to a part's."""
        started = time.process_time()
        yield
        spent = time.process_time() - started
        self.seconds[part] = self.seconds.get(part, 0.0) + spent


Iteration = Callable[[Stopwatch], int]
"""One iteration of a script; returns by how many its times are to be divided."""


def ecpo() -> Iteration:
    """A lift and its projections."""
    collector, loss_module, optimizer = make_ecpo(LEVEL, NUM_GROUPS, make_actor())
    batches = iter(collector)

    def iterate(part: Stopwatch) -> int:
        with part("lift"):
            collector.update_policy_weights_()
        for _ in range(PROJECT_STEPS):
            with part("collect"):
                groups = next(batches)
            with part("forward"):
                losses = loss_module(groups)
            with part("backward"):
                optimizer.zero_grad()
                losses["loss_actor"].backward()
            with part("optimizer"):
                clip_grad_norm_(loss_module.parameters(), MAX_GRAD_NORM)
                optimizer.step()
        return PROJECT_STEPS

    return iterate


def control(loss: str) -> Iteration:
    """A batch of the collector, and an update for each of its frames."""
    config = configure([f"loss={loss}"])
    parts = make_parts(config)
    _, _, loss_module, updater, optimizer = parts
    replay_buffer, batches = make_data(config, parts)

    def iterate(part: Stopwatch) -> int:
        with part("collect"):
            transitions = next(batches)
        with part("extend"):
            replay_buffer.extend(transitions.select(*loss_module.in_keys, strict=False))
        for _ in range(len(transitions)):
            with part("sample"):
                batch = replay_buffer.sample()
            with part("forward"):
                losses = total(loss_module(batch), is_policy_due=True)
            with part("backward"):
                losses.backward()
            with part("optimizer"):
                optimizer.step()
                optimizer.zero_grad()
            with part("updater"):
                updater.step()
        return len(transitions)

    return iterate


def measure(iterate: Iteration, repeats: int) -> dict[str, float]:
    """Median milliseconds of the parts."""
    seen: list[dict[str, float]] = []
    for _ in range(repeats + 3):
        part = Stopwatch()
        count = iterate(part)
        seen.append({name: 1e3 * spent / count for name, spent in part.seconds.items()})
    return {name: statistics.median(times[name] for times in seen[3:]) for name in seen[0]}


def main() -> None:
    arguments = read_arguments(__doc__, repeats=20)
    scripts = {"ecpo": ecpo(), "ecac": control("ecac"), "sac": control("sac")}
    table = []
    for script, iterate in scripts.items():
        parts = measure(iterate, arguments.repeats)
        for part, ms in parts.items():
            share = ms / sum(parts.values())
            print(f"{script:6}{part:12}{ms:8.2f} ms{100 * share:6.0f} %", flush=True)
            table.append({"script": script, "part": part, "ms": ms, "share": share})
    write_csv(arguments.csv, table)


if __name__ == "__main__":
    main()
