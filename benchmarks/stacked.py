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

import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from common import read_arguments, write_csv
from loop import PROJECT_STEPS, Iteration, bias_to_last, take_turns
from torch.nn.utils import clip_grad_norm_

from torchrl_ecpo.experiment import compose_options

SCRIPT = Path(__file__).resolve().parents[1] / "sota-implementations/ecpo"
sys.path.insert(0, str(SCRIPT))

from stacked.training import Stack  # noqa: E402 # pyright: ignore[reportMissingImports]
from tasks import make_task  # noqa: E402 # pyright: ignore[reportMissingImports]
from utils import (  # noqa: E402 # pyright: ignore[reportMissingImports]
    make_collector,
    make_loss,
    make_optimizer,
    make_run,
    make_temperatures,
)


def compose_run(env: str, level: int | None, seed: int) -> Any:
    """The configuration of a run."""
    options = [f"env={env}", f"seed={seed}", "form=paper"]
    if level:
        options += ["policy=lstm", "optim.lr=1e-9"]
    return compose_options(SCRIPT, options)


def single_run(env: str, level: int | None) -> Iteration:
    """One iteration of a run by itself."""
    config = compose_run(env, level, seed=0)
    task = make_task(config)
    lengthen(task, level)
    collector = make_collector(config, task)
    loss_module: Any = make_loss(config.loss, task.actor)
    optimizer = make_optimizer(config.optim, loss_module.parameters())
    temperatures = make_temperatures(config.loss, loss_module)
    run, batches, iteration = make_run(config, task), iter(collector), 0

    def iterate() -> int:
        nonlocal iteration
        if iteration % PROJECT_STEPS == 0:
            collector.update_policy_weights_()
        iteration += 1
        groups = next(batches)
        losses = loss_module(groups)
        optimizer.zero_grad()
        losses["loss_actor"].backward()
        grad_norm = clip_grad_norm_(loss_module.parameters(), 50.0)
        metrics = {**losses.detach(), "grad_norm": grad_norm}
        run.check(metrics, iteration)
        optimizer.step()
        run.log({**metrics, **task.measure(groups), **temperatures.values()}, iteration)
        return 1

    return iterate


def stacked_runs(env: str, level: int | None, number: int) -> Iteration:
    """One iteration of a stack."""
    # A directory for each stack: stacks that take turns in one would each write its files anew.
    names = {seed: f"{env}_{level}_stack_of_{number}_seed_{seed}" for seed in range(number)}
    configs = {name: compose_run(env, level, seed) for seed, name in names.items()}
    stack = Stack(configs)
    for member in stack.members:
        lengthen(member.task, level)
        member.config.project_steps = PROJECT_STEPS
        member.config.evaluation.interval = 1_000_000

    def iterate() -> int:
        stack.lift()
        stack.project()
        return 1

    return iterate


def lengthen(task: Any, level: int | None) -> None:
    """Put the curriculum of a run at a level, and bias its policy."""
    if level is not None:
        task.env.curriculum.levels.fill_(level)
        task.env.curriculum.kind = None
        bias_to_last(task.actor)


def main() -> None:
    arguments = read_arguments(__doc__, runs=[1, 2, 4, 8], levels=[2, 10], repeats=10)
    cases = [("bandit", None), *(("reverse", level) for level in (None, *arguments.levels))]
    print("ms an iteration, processor time; gain: single runs over stacked")
    print("env      level  runs |  single  x runs  stacked |  gain")
    table = []
    path = None if arguments.csv is None else arguments.csv.resolve()
    with tempfile.TemporaryDirectory() as directory:
        os.chdir(directory)
        for env, level in cases:
            loops = [single_run(env, level)]
            loops += [stacked_runs(env, level, number) for number in arguments.runs]
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
