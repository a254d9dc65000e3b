"""Updates of the actor-critic script with and without `compile=true`.

    python benchmarks/compile.py --csv compile.csv

One thread, one process; the two take turns, with the same weights and batches. An update is the
script's: the loss on a batch of 256 random transitions of HalfCheetah, its backward pass, Adam and
the average of the delayed networks. Figures are medians of processor time in milliseconds.
"warm-up" is the wall-clock time in seconds of the first turn, which compiles; with what an earlier
run has left in inductor's cache it would be less, so that cache starts empty.
"""

from __future__ import annotations

import argparse
import time

import torch
from actor_critic import configure, random_batch, step
from csv_table import add_csv_option, write_csv
from loop import Iteration, take_turns
from torch._inductor.utils import fresh_cache
from utils import (  # pyright: ignore[reportMissingImports]
    make_actor,
    make_environment,
    make_loss,
    make_optimizer,
    make_updater,
)

from torchrl_ecpo.experiment import compile_module

UPDATES = 10  # in a turn


def update(loss: str, *, is_compiled: bool) -> Iteration:
    """Updates on one random batch, of which the loss gets a fresh copy as from a buffer."""
    config = configure([f"loss={loss}"])
    env = make_environment(config, seed=0)
    torch.manual_seed(0)
    loss_module = make_loss(config, make_actor(config, env), env)
    updater = make_updater(config, loss_module)
    optimizer = make_optimizer(config.loss.lr, loss_module)
    batch = random_batch(env.fake_tensordict(), config.replay_buffer.batch_size)
    batch = batch.select(*loss_module.in_keys)
    if is_compiled:
        compile_module(loss_module, "update")

    def iterate() -> int:
        for _ in range(UPDATES):
            step(optimizer, loss_module(batch.copy()))
            updater.step()
        return UPDATES

    return iterate


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--losses", nargs="+", default=["sac", "ecac"])
    parser.add_argument("--repeats", type=int, default=10)
    add_csv_option(parser)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    table = []
    for loss in arguments.losses:
        compiled = update(loss, is_compiled=True)
        with fresh_cache():
            started = time.perf_counter()
            compiled()
            warm_up = time.perf_counter() - started
            eager = update(loss, is_compiled=False)
            times, _, _ = take_turns([eager, compiled], arguments.repeats)
        eager_ms, compiled_ms = (time / UPDATES for time in times)
        row = {"loss": loss, "eager_ms": eager_ms, "compiled_ms": compiled_ms}
        table.append(row | {"speed": eager_ms / compiled_ms, "warm_up_s": warm_up})
    print("loss    eager ms  compiled ms  speed  warm-up s")
    for row in table:
        print(
            "{loss:8}{eager_ms:8.2f}{compiled_ms:13.2f}{speed:7.2f}{warm_up_s:11.0f}".format(**row)
        )
    write_csv(arguments.csv, table)


if __name__ == "__main__":
    main()
