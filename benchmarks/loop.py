"""The ECPO training loop on Reverse, against the same loop in bare PyTorch without TensorDict.

    python benchmarks/loop.py --levels 2 10 30
    python benchmarks/loop.py --profile --levels 10

One thread, one process; the loops take turns, each with its own environment and policy from the
same seed. An iteration collects groups of 10 trajectories, 40 by default, computes ECPO's loss and
steps Adam; every fifth copies the weights to the reference that acts. Figures are medians of
processor time in milliseconds, which other processes disturb least.

- ecpo: `TrajectoryGroupCollector`, `ECPOLoss`, Adam, as `sota-implementations/ecpo` puts them
  together.
- bare: the rules, the distribution, the LSTM over distinct histories and the loss's formula are the
  package's, called on plain tensors by a loop written for this one case: no TensorDict, no
  environment class, no keys, no checks, no diagnostics.
- plain: the bare loop with PyTorch's `LSTMCell` and `LSTM` on every row.
- window 1, window 4: the loop "ecpo" with a policy that sees the last steps, in place of the LSTM.

`--profile` tells instead what a step of collecting is made of, in microseconds.

The policy is biased so that trajectories last, as those of a trained policy do: it seldom writes
and mostly moves right. The learning rate is so small that it stays so.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from copy import deepcopy
from typing import Any, NamedTuple

import torch
from common import read_arguments, write_csv
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import clip_grad_norm_
from torch.nn.utils.rnn import pad_sequence
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor

from torchrl_ecpo import ECPOLoss
from torchrl_ecpo.collectors import TrajectoryGroupCollector
from torchrl_ecpo.collectors.rollout import GroupPlayer
from torchrl_ecpo.envs import AlgorithmicEnv
from torchrl_ecpo.functional import lifted_log_weights, mean_seeking_projection
from torchrl_ecpo.modules import DistinctHistoryLSTM, TupleCategorical, make_tuple_policy

GROUP_SIZE, PROJECT_STEPS = 10, 5
NUM_OBSERVATIONS, NVEC = 3, (2, 2, 2)  # of Reverse
NUM_CLASSES = (NUM_OBSERVATIONS, *(n + 1 for n in NVEC))
TAU, TAU_PRIME, MAX_GRAD_NORM, LEARNING_RATE = 0.5, 0.01, 50.0, 1e-9
WINDOWS = (1, 4)  # steps that policies without LSTM see
STRAY, WRITE = 0.02, 0.002  # probabilities of a move to the left and of writing

Iteration = Callable[[], int]
"""One iteration of a training loop; returns the number of steps that it made."""


def make_env(level: int, num_groups: int) -> AlgorithmicEnv:
    return AlgorithmicEnv(
        "reverse",
        min_length=level,
        curriculum=None,
        num_groups=num_groups,
        group_size=GROUP_SIZE,
        seed=0,
    )


def make_actor(
    stray: float = STRAY, write: float = WRITE, window: int | None = None
) -> ProbabilisticActor:
    """A policy whose trajectories last."""
    torch.manual_seed(0)
    actor = make_tuple_policy(NUM_OBSERVATIONS, NVEC, window=window)
    bias_to_last(actor, stray, write)
    return actor


def bias_to_last(actor: nn.Module, stray: float = STRAY, write: float = WRITE) -> None:
    """Let a policy move left with probability `stray` and write with probability `write`."""
    *_, readout = (module for module in actor.modules() if isinstance(module, nn.Linear))
    bias = torch.tensor([stray, 1 - stray, 1 - write, write, 0.5, 0.5]).log()
    with torch.no_grad():
        readout.bias.copy_(bias.expand_as(readout.bias))


def make_ecpo(
    level: int, num_groups: int, actor: ProbabilisticActor
) -> tuple[TrajectoryGroupCollector, ECPOLoss, torch.optim.Optimizer]:
    """The parts of the package's loop, as the script has them."""
    env = make_env(level, num_groups)
    collector = TrajectoryGroupCollector(
        env, actor, num_groups=num_groups, group_size=GROUP_SIZE, exclude_keys=["logits"]
    )
    loss_module = ECPOLoss(actor, tau=TAU, tau_prime=TAU_PRIME)
    return collector, loss_module, torch.optim.Adam(loss_module.parameters(), lr=LEARNING_RATE)


def ecpo_loop(level: int, num_groups: int, actor: ProbabilisticActor) -> Iteration:
    """The package's loop."""
    collector, loss_module, optimizer = make_ecpo(level, num_groups, actor)
    batches = iter(collector)
    iteration = 0

    def iterate() -> int:
        nonlocal iteration
        if iteration % PROJECT_STEPS == 0:
            collector.update_policy_weights_()
        iteration += 1
        groups = next(batches)
        losses = loss_module(groups)
        optimizer.zero_grad()
        losses["loss_actor"].backward()
        clip_grad_norm_(loss_module.parameters(), MAX_GRAD_NORM)
        optimizer.step()
        return int(groups["collector", "mask"].sum())

    return iterate


State = tuple[Tensor, Tensor]


class Steps(NamedTuple):
    """The steps of `N` trajectories, `[T, N]` and padded."""

    symbol: Tensor
    """Observation and previous action as one number."""
    action: Tensor
    log_prob: Tensor
    reward: Tensor
    mask: Tensor


class DistinctNet:
    """Logits from the LSTM over distinct histories, on plain tensors."""

    def __init__(self, core: DistinctHistoryLSTM) -> None:
        self.core = core

    def step(self, symbol: Tensor, state: State | None) -> tuple[Tensor, State]:
        """Logits and state `[n, *]` of one step; without a state, the first."""
        starts = torch.full((1, len(symbol)), state is None)
        nodes, logits, states, _ = self.core.evaluate(symbol.unsqueeze(0), starts, states=state)
        h, c = (value.squeeze(1).index_select(0, nodes[0]) for value in states.values())
        return logits.index_select(0, nodes[0]), (h, c)

    def unroll(self, steps: Steps) -> Tensor:
        """Logits `[T, N, L]` of whole trajectories."""
        starts = ~steps.mask
        starts[0] = True
        nodes, logits, *_ = self.core.evaluate(steps.symbol, starts, steps.mask)
        return logits.index_select(0, nodes.flatten()).view(*nodes.shape, -1)


class PlainNet:
    """Logits from PyTorch's LSTM on every row, with the same weights."""

    def __init__(self, core: DistinctHistoryLSTM) -> None:
        cell = core.cell
        self.cell, self.readout = cell, core.readout
        self.lstm = nn.LSTM(cell.input_size, cell.hidden_size)
        self.lstm.weight_ih_l0, self.lstm.weight_hh_l0 = cell.weight_ih, cell.weight_hh
        self.lstm.bias_ih_l0, self.lstm.bias_hh_l0 = cell.bias_ih, cell.bias_hh
        every = torch.cartesian_prod(*map(torch.arange, NUM_CLASSES)).unbind(1)
        hots = [F.one_hot(x, n) for x, n in zip(every, NUM_CLASSES, strict=True)]
        self.one_hot = torch.cat(hots, -1).float()

    def step(self, symbol: Tensor, state: State | None) -> tuple[Tensor, State]:
        """Logits and state `[n, *]` of one step; without a state, the first."""
        h, c = self.cell(self.one_hot.index_select(0, symbol), state)
        return self.readout(h), (h, c)

    def unroll(self, steps: Steps) -> Tensor:
        """Logits `[T, N, L]` of whole trajectories."""
        return self.readout(self.lstm(self.one_hot[steps.symbol])[0])


def collect(env: AlgorithmicEnv, net: DistinctNet | PlainNet, weights: Tensor) -> Steps:
    """Play every trajectory to its end; rows that have ended are dropped."""
    rows = env._every_row
    env._queue.clear()
    env._start(rows)
    played: list[tuple[Tensor, ...]] = []
    state: State | None = None
    while len(rows):
        inputs = torch.cat([env._observation[rows].unsqueeze(1), env._previous_action[rows]], 1)
        symbol = (inputs * weights).sum(1)
        logits, state = net.step(symbol, state)
        distribution = TupleCategorical(logits, NVEC, validate_args=False)
        action = distribution.sample()
        log_prob = distribution.log_prob(action)
        reward = env._advance(rows, action)
        played.append((rows, symbol, action, log_prob, reward))
        ended = env._ended[rows]
        if ended.any():
            going_on = (~ended).nonzero().squeeze(1)
            h, c = state
            rows = rows[going_on]
            state = h.index_select(0, going_on), c.index_select(0, going_on)
    row, *values = (torch.cat(column) for column in zip(*played, strict=True))
    order = row.argsort(stable=True)
    lengths = row.bincount().tolist()
    symbol, action, log_prob, reward = (
        pad_sequence(list(value[order].split(lengths))) for value in values
    )
    mask = torch.arange(max(lengths)).unsqueeze(1) < torch.tensor(lengths)
    return Steps(symbol, action, log_prob, reward, mask)


def bare_loop(
    level: int,
    num_groups: int,
    actor: ProbabilisticActor,
    make_net: type[DistinctNet] | type[PlainNet],
) -> Iteration:
    """The loop on plain tensors."""
    env = make_env(level, num_groups)
    core = next(module for module in actor.modules() if isinstance(module, DistinctHistoryLSTM))
    reference = deepcopy(core)
    net, reference_net = make_net(core), make_net(reference)
    optimizer = torch.optim.Adam(core.parameters(), lr=LEARNING_RATE)
    sizes = torch.tensor(NUM_CLASSES)
    weights = sizes.flip(0).cumprod(0).flip(0) // sizes
    iteration = 0

    def iterate() -> int:
        nonlocal iteration
        if iteration % PROJECT_STEPS == 0:
            reference.load_state_dict(core.state_dict())
        iteration += 1
        with torch.no_grad():
            steps = collect(env, reference_net, weights)
        distribution = TupleCategorical(net.unroll(steps), NVEC, validate_args=False)
        log_prob = distribution.log_prob(steps.action).where(steps.mask, 0.0)
        log_prob, reference_log_prob, returns = (
            values.sum(0).view(num_groups, GROUP_SIZE)
            for values in (log_prob, steps.log_prob, steps.reward)
        )
        lift = lifted_log_weights(returns, reference_log_prob, tau=TAU, tau_prime=TAU_PRIME)
        loss = mean_seeking_projection(log_prob, lift).loss
        optimizer.zero_grad()
        loss.mean().backward()
        clip_grad_norm_(core.parameters(), MAX_GRAD_NORM)
        optimizer.step()
        return int(steps.mask.sum())

    return iterate


def take_turns(loops: list[Iteration], repeats: int) -> tuple[list[float], ...]:
    """Median processor and wall-clock times in milliseconds, and steps, of an iteration of each."""
    figures: list[list[tuple[float, float, int]]] = [[] for _ in loops]
    for repeat in range(repeats + 2):
        for iterate, seen in zip(loops, figures, strict=True):
            processor, wall = time.process_time(), time.perf_counter()
            steps = iterate()
            times = time.process_time() - processor, time.perf_counter() - wall
            if repeat > 1:
                seen.append((1e3 * times[0], 1e3 * times[1], steps))
    medians = [
        [statistics.median(column) for column in zip(*seen, strict=True)] for seen in figures
    ]
    processor, wall, steps = (list(column) for column in zip(*medians, strict=True))
    return processor, wall, steps


# What is timed in a step of collecting. The rest of a part is what is left of the whole one.
TIMED: dict[str, list[tuple[Any, str]]] = {
    "collecting": [(GroupPlayer, "play"), (sys.modules[__name__], "collect")],
    "policy": [(GroupPlayer, "_act")],
    "LSTM": [(DistinctHistoryLSTM, "evaluate")],
    "distribution": [
        (TupleCategorical, name) for name in ("sample", "log_prob", "sample_and_log_prob")
    ],
    "env.step": [(EnvBase, "step")],
    "rules": [(AlgorithmicEnv, "_advance")],
    "new instances": [(AlgorithmicEnv, "_start")],
}


class Timers:
    """Processor time spent in the functions of `TIMED` while nothing records gradients."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.running: set[str] = set()
        for part, functions in TIMED.items():
            for owner, name in functions:
                if hasattr(owner, name):
                    setattr(owner, name, self.time(part, getattr(owner, name)))

    def time(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, timed unless it is called by another one of the same part."""

        def timed(*args: Any, **kwargs: Any) -> Any:
            is_update = torch.is_grad_enabled() and part != "collecting"
            if is_update or part in self.running:
                return function(*args, **kwargs)
            self.running.add(part)
            start = time.process_time()
            try:
                return function(*args, **kwargs)
            finally:
                self.seconds[part] += time.process_time() - start
                self.running.remove(part)

        return timed


def profile(loops: list[Iteration], repeats: int, num_steps: int) -> list[dict[str, float]]:
    """Median microseconds of the parts of a step of collecting, of each loop."""
    timers = Timers()
    seen: list[dict[str, list[float]]] = [{part: [] for part in TIMED} for _ in loops]
    for repeat in range(repeats + 2):
        for iterate, times in zip(loops, seen, strict=True):
            timers.seconds.clear()
            iterate()
            if repeat > 1:
                for part in TIMED:
                    times[part].append(1e6 * timers.seconds[part] / num_steps)
    return [split({part: statistics.median(xs) for part, xs in times.items()}) for times in seen]


def split(times: dict[str, float]) -> dict[str, float]:
    """Parts that add up."""
    inner = times["LSTM"] + times["distribution"]
    step = max(times["env.step"], times["rules"])
    policy = max(times["policy"], inner)
    return {
        "LSTM over distinct histories": times["LSTM"],
        "distribution": times["distribution"],
        "rest of the policy": policy - inner,
        "rules of the task": times["rules"],
        "rest of env.step": step - times["rules"],
        "new instances": times["new instances"],
        "everything else": times["collecting"] - policy - step - times["new instances"],
        "all": times["collecting"],
    }


def print_profile(arguments: argparse.Namespace) -> None:
    level = arguments.levels[0]
    actors = [make_actor(arguments.stray, arguments.write) for _ in range(2)]
    loops = [
        ecpo_loop(level, arguments.groups, actors[0]),
        bare_loop(level, arguments.groups, actors[1], DistinctNet),
    ]
    # Right moves only, and nothing written: the longest instance's time limit.
    ecpo, bare = profile(loops, arguments.repeats, num_steps=2 * (level + 2) + 5)
    print(f"us a step of collecting, level {level}     ecpo   bare")
    for part in ecpo:
        print(f"{part:38} {ecpo[part]:7.0f} {bare[part]:6.0f}")
    rows = [
        {"part": part, "ecpo_us": round(ecpo[part]), "bare_us": round(bare[part])} for part in ecpo
    ]
    write_csv(arguments.csv, rows)


def main() -> None:
    arguments = read_arguments(
        __doc__, levels=[2, 10, 30], groups=40, stray=STRAY, write=WRITE, repeats=10, profile=False
    )
    if arguments.profile:
        print_profile(arguments)
        return
    names = ["ecpo", "bare", "plain", *(f"window {window}" for window in WINDOWS)]
    over = ["bare/ecpo", "plain/ecpo", *(f"ecpo/{name}" for name in names[3:])]
    print("ms an iteration: processor (wall clock); ratios of processor time")
    print("level  steps |", " | ".join([*(f"{name:^13}" for name in names), "  ".join(over)]))
    table = []
    for level in arguments.levels:
        windows = (None, None, None, *WINDOWS)
        actors = [make_actor(arguments.stray, arguments.write, window) for window in windows]
        loops = [
            ecpo_loop(level, arguments.groups, actors[0]),
            bare_loop(level, arguments.groups, actors[1], DistinctNet),
            bare_loop(level, arguments.groups, actors[2], PlainNet),
            *(ecpo_loop(level, arguments.groups, actor) for actor in actors[3:]),
        ]
        processor, wall, steps = take_turns(loops, arguments.repeats)
        cells = [f"{level:5d} {steps[0]:6.0f}"]
        cells += [f"{x:5.0f} ({y:5.0f})" for x, y in zip(processor, wall, strict=True)]
        times = dict(zip(names, processor, strict=True))
        ratios = {name: times[(pair := name.split("/"))[0]] / times[pair[1]] for name in over}
        cells.append("  ".join(f"{ratio:{len(name)}.2f}" for name, ratio in ratios.items()))
        print(" | ".join(cells), flush=True)
        row = {"level": level, "groups": arguments.groups, "stray": arguments.stray}
        row |= {"steps": round(steps[0])}
        for name, x, y in zip(names, processor, wall, strict=True):
            row |= {f"{name}_ms": x, f"{name}_wall_ms": y}
        table.append(row | {name.replace("/", "_over_"): ratio for name, ratio in ratios.items()})
    write_csv(arguments.csv, table)


if __name__ == "__main__":
    main()
