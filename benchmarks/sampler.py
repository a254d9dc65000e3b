"""Processor time of `TrajectoryGroupSampler` for storages of 1e4 to 1e6 steps.

Run: python benchmarks/sampler.py
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import torch
from common import read_arguments, write_csv
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_ecpo.groups import TrajectoryGroupSampler

GROUP_SIZE, NUM_GROUPS = 10, 40
MEAN_LENGTH = 10


def make_groups(first_group: int, num_steps: int) -> TensorDict:
    """About `num_steps` steps of complete groups, as a collector writes them."""
    num_trajectories = max(num_steps // MEAN_LENGTH // GROUP_SIZE, 1) * GROUP_SIZE
    length = torch.randint(1, 2 * MEAN_LENGTH, (num_trajectories,))
    trajectory = torch.arange(num_trajectories).repeat_interleave(length)
    done = torch.zeros(len(trajectory), 1, dtype=torch.bool)
    done[length.cumsum(0) - 1] = True
    return TensorDict(
        {
            "observation": torch.randn(len(trajectory), 8),
            "group": first_group + trajectory // GROUP_SIZE,
            "collector": {"traj_ids": first_group * GROUP_SIZE + trajectory},
            "next": {"done": done, "reward": torch.randn(len(trajectory), 1)},
        },
        [len(trajectory)],
    )


def milliseconds(run: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return 1e3 * median(times)


def measure(size: int, repeats: int) -> tuple[float, ...]:
    """Return the cost of writing and drawing with a storage of `size` steps."""
    sampler = TrajectoryGroupSampler(group_size=GROUP_SIZE)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(size), sampler=sampler, batch_size=NUM_GROUPS * GROUP_SIZE
    )
    written = 0
    while written < size:
        buffer.extend(make_groups(written, min(size, 100_000)))
        written += 100_000
    batch = make_groups(10**9, NUM_GROUPS * GROUP_SIZE * MEAN_LENGTH)
    storage, count = buffer.storage, NUM_GROUPS * GROUP_SIZE

    def write_groups() -> None:
        batch["group"] += NUM_GROUPS  # ids are unique: those of a batch before are other groups
        batch["collector", "traj_ids"] += count
        buffer.extend(batch)

    def write_and_draw() -> None:
        write_groups()
        sampler.sample(storage, count)

    write = milliseconds(write_groups, repeats)
    first = milliseconds(write_and_draw, repeats)
    draw = milliseconds(lambda: sampler.sample(storage, count), repeats)
    sample = milliseconds(buffer.sample, repeats)
    return write, first, draw, sample


def main() -> None:
    arguments = read_arguments(__doc__, sizes=[1e4, 3e4, 1e5, 3e5, 1e6], repeats=100)
    torch.manual_seed(0)
    print(f"{NUM_GROUPS} groups of {GROUP_SIZE} trajectories a draw and a write, one thread")
    columns = ("steps", "write ms", "write+draw ms", "draw ms", "sample ms")
    print("".join(f"{column:>14}" for column in columns))
    table = []
    for size in map(int, arguments.sizes):
        figures = measure(size, arguments.repeats)
        print(f"{size:>14,}" + "".join(f"{figure:>14.2f}" for figure in figures))
        names = (column.replace(" ", "_").replace("+", "_and_") for column in columns)
        table.append(dict(zip(names, (size, *figures), strict=True)))
    write_csv(arguments.csv, table)


if __name__ == "__main__":
    main()
