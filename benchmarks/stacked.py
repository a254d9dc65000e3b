"""Stacked runs of the ECPO script against as many single runs, on one core.

    python benchmarks/stacked.py --csv benchmarks/results/stacked.csv

One thread, one process; the two take turns. An iteration is the script's: groups are collected, the
loss computed, each run's gradient clipped, Adam steps, each run is measured; every fifth iteration
copies the weights to the reference. Figures are medians of processor time in milliseconds. "single"
is one run by itself, of which as many processes as there are runs would each take as much.

On Reverse the policies are biased so that trajectories last, as those of a trained policy do, and
the learning rate is so small that they stay so. Without a level the policies are as they begin.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from csv_table import add_csv_option, write_csv
from hydra import compose, initialize_config_dir
from loop import PROJECT_STEPS, Iteration, bias_to_last, take_turns

SCRIPT = Path(__file__).resolve().parents[1] / "sota-implementations/ecpo"
sys.path.insert(0, str(SCRIPT))

from stack import make_stack  # noqa: E402 # pyright: ignore[reportMissingImports]
from utils import (  # noqa: E402 # pyright: ignore[reportMissingImports]
    make_optimizer,
    make_parts,
)


def make_iteration(env: str, level: int | None, seeds: list[int] | None) -> Iteration:
    """One iteration of a single run, or of stacked ones."""
    options = [f"env={env}", f"seeds={'null' if seeds is None else seeds}", "logger.backend=none"]
    with initialize_config_dir(str(SCRIPT / "config"), version_base="1.3"):
        config = compose("config", overrides=[*options, *(["optim.lr=1e-9"] if level else [])])
    parts = make_parts(config) if seeds is None else make_stack(config)
    if level is not None:
        lengthen(parts, level)
    optimizer = make_optimizer(config.optim, parts.loss_module)
    batches = iter(parts.collector)
    iteration = 0

    def iterate() -> int:
        nonlocal iteration
        if iteration % PROJECT_STEPS == 0:
            parts.collector.update_policy_weights_()
        iteration += 1
        groups = next(batches)
        losses = parts.loss_module(groups)
        optimizer.zero_grad()
        losses["loss_actor"].sum().backward()
        metrics = {**losses.detach(), "grad_norm": parts.clip_grad_norm_(50.0)}
        parts.run.check(metrics, iteration)
        optimizer.step()
        metrics |= {**parts.task.measure(groups), **parts.temperatures.values()}
        parts.run.log(metrics, iteration)
        return 1

    return iterate


def lengthen(parts: Any, level: int) -> None:
    """Put the curriculum of each run at a level, and bias its policy."""
    env = parts.task.env
    for own in getattr(env, "runs", [env]):
        own.curriculum.levels.fill_(level)
        own.curriculum.kind = None
    bias_to_last(parts.task.actor)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--levels", type=int, nargs="*", default=[2, 10], help="of Reverse")
    parser.add_argument("--repeats", type=int, default=10)
    add_csv_option(parser)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cases = [("bandit", None), *(("reverse", level) for level in (None, *arguments.levels))]
    print("ms an iteration, processor time; gain: single runs over stacked")
    print("env      level  runs |  single  x runs  stacked |  gain")
    table = []
    path = None if arguments.csv is None else arguments.csv.resolve()
    with tempfile.TemporaryDirectory() as directory:
        os.chdir(directory)
        for env, level in cases:
            loops = [make_iteration(env, level, None)]
            loops += [make_iteration(env, level, list(range(n))) for n in arguments.runs]
            (single, *stacked), _, _ = take_turns(loops, arguments.repeats)
            for runs, ms in zip(arguments.runs, stacked, strict=True):
                gain = runs * single / ms
                shown = "begin" if level is None else str(level)
                print(
                    f"{env:8} {shown:>5} {runs:5d} | {single:7.1f} {runs * single:7.1f} {ms:8.1f}"
                    f" | {gain:5.2f}",
                    flush=True,
                )
                row = {"env": env, "level": "" if level is None else level, "runs": runs}
                table.append(row | {"single_ms": single, "stacked_ms": ms, "gain": gain})
        os.chdir("/")
    write_csv(path, table)


if __name__ == "__main__":
    main()
