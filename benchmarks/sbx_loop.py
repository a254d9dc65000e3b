"""Frames of sbx's SAC, which is Stable-Baselines3's in JAX, against those of the original.

    python -m venv sbx && sbx/bin/pip install sbx-rl==0.28 'gymnasium[mujoco]' 'mujoco<4'
    sbx/bin/python benchmarks/sbx_loop.py --csv sbx_loop.csv

In an environment of its own, as it brings JAX, and without this package: `actor_critic.py` has the
same peer, so that the two ratios compare. One thread, HalfCheetah-v5, all that a frame takes;
medians of processor time, in turns.
"""

from __future__ import annotations

import os
import time
from statistics import median

# Before JAX is imported.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import sbx  # pyright: ignore[reportMissingImports]
import stable_baselines3  # pyright: ignore[reportMissingImports]
from common import read_arguments, write_csv

FRAMES = 200  # in a turn


def main() -> None:
    arguments = read_arguments(__doc__, repeats=10)
    packages = {"Stable-Baselines3 SAC": stable_baselines3, "sbx SAC": sbx}
    options = {"learning_starts": 0, "seed": 0}
    models = {
        name: package.SAC("MlpPolicy", "HalfCheetah-v5", **options)
        for name, package in packages.items()
    }
    times: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(arguments.repeats + 1):
        for name, model in models.items():
            start = time.process_time()
            model.learn(FRAMES, reset_num_timesteps=False)
            times[name].append((time.process_time() - start) / FRAMES * 1000)
    first, *_ = medians = [median(taken[1:]) for taken in times.values()]  # the first compiles
    rows = [
        {"method": name, "ms": ms, "speed": first / ms}
        for name, ms in zip(models, medians, strict=True)
    ]
    for row in rows:
        print("{method:24}{ms:10.2f} ms a frame{speed:8.2f} of the speed".format(**row))
    write_csv(arguments.csv, rows)


if __name__ == "__main__":
    main()
