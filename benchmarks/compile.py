"""Updates of the actor-critic script with and without `compile=true`.

    python benchmarks/compile.py --csv compile.csv

One thread, one process; the two take turns, with the same weights and batches. An update is the
script's: the loss on a batch of 256 random transitions of HalfCheetah, its backward pass, Adam and
the average of the delayed networks. Figures are medians of processor time in milliseconds.
"warm-up" is the wall-clock time in seconds of the first turn, which compiles; with what an earlier
run has left in inductor's cache it would be less, so that cache starts empty.
"""

from __future__ import annotations

import time

from actor_critic import NUM_UPDATES, configure, update
from common import read_arguments, write_csv
from loop import take_turns
from torch._inductor.utils import fresh_cache


def main() -> None:
    arguments = read_arguments(__doc__, losses=["sac", "ecac"], repeats=10)
    table = []
    for loss in arguments.losses:
        options = [f"loss={loss}"]
        compiled = update(configure([*options, "compile=true"]))
        with fresh_cache():
            started = time.perf_counter()
            compiled()
            warm_up = time.perf_counter() - started
            eager = update(configure(options))
            times, _, _ = take_turns([eager, compiled], arguments.repeats)
        eager_ms, compiled_ms = (time / NUM_UPDATES for time in times)
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
