"""How the time and memory of an update grow with its sizes.

    python benchmarks/growth.py --csv growth.csv

One thread; each point in a process of its own. An update is a loss's forward and backward pass,
median processor time in milliseconds; memory is by how much updates raise the peak of the process,
in MB. One size varies at a time, the others are as in the first row.

- ECPOLoss: G groups of K trajectories of T steps as on Reverse, but with random observations and
  actions, so that few histories are shared: the dearest case.
- ECACLoss: B random transitions of HalfCheetah, M actions at each of B / 2 states.
"""

from __future__ import annotations

import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable

import torch
from actor_critic import configure, make_parts, random_batch
from common import read_arguments, write_csv
from ecac import total  # pyright: ignore[reportMissingImports]
from loop import NUM_OBSERVATIONS, NVEC, TAU, TAU_PRIME
from tensordict import TensorDict
from torch import Tensor

from torchrl_ecpo import ECPOLoss
from torchrl_ecpo.modules import make_tuple_policy


def ecpo(G: int, K: int, T: int) -> Callable[[], Tensor]:
    """The loss of a batch of random observations and actions."""
    actor = make_tuple_policy(NUM_OBSERVATIONS, NVEC)
    loss_module = ECPOLoss(actor, tau=TAU, tau_prime=TAU_PRIME)
    never = torch.zeros(G, K, T, 1, dtype=torch.bool)
    is_init = never.clone()
    is_init[:, :, 0] = True
    action = torch.randint(2, (G, K, T, len(NVEC)))
    batch = TensorDict(
        {
            "observation": torch.randint(NUM_OBSERVATIONS, (G, K, T)),
            "previous_action": action.roll(1, 2),
            "is_init": is_init,
            "action": action,
            "action_log_prob": torch.randn(G, K, T),
            "next": {"reward": torch.randn(G, K, T, 1), "done": never, "terminated": never},
        },
        batch_size=[G, K, T],
    )
    return lambda: loss_module(batch.copy())["loss_actor"]


def ecac(B: int, M: int) -> Callable[[], Tensor]:
    """The losses of a batch of random transitions."""
    sizes = [f"loss.num_action_samples={M}", f"loss.num_actor_states={B // 2}"]
    env, _, loss_module, *_ = make_parts(configure(["loss=ecac", *sizes]))
    batch = random_batch(env.fake_tensordict(), B)
    return lambda: total(loss_module(batch.copy()), is_policy_due=True)


CASES: dict[str, tuple[Callable[..., Callable[[], Tensor]], dict[str, tuple[int, ...]]]] = {
    "ECPOLoss": (ecpo, {"G": (40, 10, 160), "K": (10, 5, 20, 40), "T": (25, 12, 50)}),
    "ECACLoss": (ecac, {"B": (256, 64, 1024), "M": (8, 2, 32)}),
}
"""For each loss its maker, and the values of its sizes; the first is where the others vary."""


def points(sizes: dict[str, tuple[int, ...]]) -> list[dict[str, int]]:
    """The first values, and each other value with them."""
    first = {name: values[0] for name, values in sizes.items()}
    return [
        first,
        *({**first, name: value} for name, values in sizes.items() for value in values[1:]),
    ]


def peak() -> float:
    """The most memory that the process has had, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(loss: str, sizes: dict[str, int], repeats: int) -> tuple[float, float]:
    """Milliseconds of an update, and the memory that it takes."""
    torch.manual_seed(0)
    make, _ = CASES[loss]
    compute = make(**sizes)
    before, times = peak(), []
    for _ in range(repeats + 2):
        started = time.process_time()
        compute().backward()
        times.append(time.process_time() - started)
    return 1e3 * statistics.median(times[2:]), peak() - before


def main() -> None:
    arguments = read_arguments(__doc__, repeats=10)
    table = []
    # A fork starts with the memory of the parent, which has computed nothing.
    with multiprocessing.get_context("fork").Pool(1, maxtasksperchild=1) as processes:
        for loss, (_, values) in CASES.items():
            for sizes in points(values):
                ms, megabytes = processes.apply(measure, (loss, sizes, arguments.repeats))
                shown = ", ".join(f"{name} = {value}" for name, value in sizes.items())
                print(f"{loss:10}{shown:24}{ms:8.1f} ms{megabytes:8.1f} MB", flush=True)
                table.append({"loss": loss, "sizes": shown, "ms": ms, "peak_mb": megabytes})
    write_csv(arguments.csv, table)


if __name__ == "__main__":
    main()
