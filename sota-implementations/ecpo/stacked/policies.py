"""The policies of all runs as one, over rows that come run after run.

An entry ``run`` says whose each row is. The runs share what does not depend on the weights, and
every elementwise operation; matrix products are made run by run, on the same rows in the same order
as by a run alone, so that its numbers are the same. The modules are those of the runs' own
policies: a gradient arrives where the run alone would have it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from torchrl_ecpo.modules import DistinctHistoryLSTM, DistinctWindowNetwork, TupleCategorical
from torchrl_ecpo.modules.distinct import take_rows
from torchrl_ecpo.modules.histories import Histories, distinct_histories, hash_histories
from torchrl_ecpo.modules.tuple_policy import TuplePolicy

BITS_OF_RUN = 10  # of the hash of a history: two collide with probability 2^-54


def stack_policies(actors: Sequence[Any], random_states: Sequence[Tensor]) -> StackedPolicy:
    """Put the policies of all runs behind one.

    Args:
        actors: one for each run.
        random_states: of the random generator that each run samples with, as
            `torch.get_rng_state` gives them.
    """
    kind = _StackedTuplePolicy if isinstance(actors[0], TuplePolicy) else _SeparatePolicies
    return kind(actors, RandomStreams(random_states))


class StackedPolicy(TensorDictModuleBase):
    """A policy for each run, with random numbers of its own."""

    runs: nn.ModuleList
    """What each run's policy consists of; of parameters and buffers there is nothing else."""
    streams: RandomStreams

    @abstractmethod
    def log_prob(self, steps: TensorDictBase) -> Callable[[], Tensor]:
        """What gives the log-probability ``[N, T]`` of trajectories, by the weights of then."""

    def copy_run(self, run: int, other: StackedPolicy) -> None:
        """Take over the weights that another stack has for a run."""
        self.runs[run].load_state_dict(other.runs[run].state_dict())

    def _count_rows(self, tensordict: TensorDictBase) -> list[int]:
        """How many rows each run has.

        Raises:
            ValueError: if the rows do not come run after run.
        """
        runs = tensordict.get("run").flatten()
        if (runs.diff() < 0).any():
            raise ValueError(f"The rows must come run after run, got 'run' = {runs.tolist()}.")
        return runs.bincount(minlength=len(self.runs)).tolist()


class RandomStreams(nn.Module):
    """A random generator for each run; their states are part of the state dict."""

    def __init__(self, states: Sequence[Tensor]) -> None:
        super().__init__()
        self.generators = [torch.Generator() for _ in states]
        self.set_extra_state(torch.stack(list(states)))

    def get_extra_state(self) -> Tensor:
        """The states, uint8 ``[R, n]``."""
        return torch.stack([generator.get_state() for generator in self.generators])

    def set_extra_state(self, state: Tensor) -> None:
        """Go on from there."""
        for generator, own in zip(self.generators, state.cpu(), strict=True):
            generator.set_state(own.clone())  # torch reads a view from its storage's beginning

    def uniform(self, sizes: Sequence[int], like: Tensor) -> Tensor:
        """Numbers in [0, 1), three for each row of logits ``[*B, L]``: `sizes` rows of each run."""
        dtype = torch.promote_types(like.dtype, torch.float32)  # as TupleCategorical.sample
        parts = zip(sizes, self.generators, strict=True)
        draws = [torch.rand(n, 3, generator=own, dtype=dtype) for n, own in parts]
        return torch.cat(draws).view(*like.shape[:-1], 3)

    @contextmanager
    def drawing_from(self, run: int) -> Iterator[None]:
        """Within, what draws from torch's global generator draws from a run's."""
        before = torch.get_rng_state()
        torch.set_rng_state(self.generators[run].get_state())
        try:
            yield
        finally:
            self.generators[run].set_state(torch.get_rng_state())
            torch.set_rng_state(before)


class _SeparatePolicies(StackedPolicy):
    """Evaluates the policy of each run on its rows: the bandit's, of which there is one row."""

    def __init__(self, actors: Sequence[Any], streams: RandomStreams) -> None:
        super().__init__()
        keys: list[Any] = ["run", "action", "action_log_prob"]
        self.in_keys, self.out_keys = [*actors[0].in_keys, *keys[:1]], keys[1:]
        self.runs, self.streams = nn.ModuleList(actors), streams

    def _parts(self, tensordict: TensorDictBase) -> Iterator[tuple[Any, TensorDictBase]]:
        parts: Any = tensordict.split(self._count_rows(tensordict))
        return zip(self.runs, parts, strict=True)

    def log_prob(self, steps: TensorDictBase) -> Callable[[], Tensor]:
        parts = [(actor, part, part["action"]) for actor, part in self._parts(steps)]
        return lambda: torch.cat([actor.get_dist(part).log_prob(a) for actor, part, a in parts])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write action and log-probability."""
        acted = []
        for run, (actor, part) in enumerate(self._parts(tensordict.reshape(-1))):
            with self.streams.drawing_from(run):
                acted.append(actor(part))
        for key in self.out_keys:
            value = torch.cat([part.get(key) for part in acted])
            tensordict.set(key, value.view(tensordict.shape))
        return tensordict


class _StackedTuplePolicy(TuplePolicy, StackedPolicy):
    """The tuple policy of each run, evaluated together."""

    def __init__(self, actors: Sequence[Any], streams: RandomStreams) -> None:
        super().__init__()
        cores = [actor.parts[0] for actor in actors]
        is_recurrent = isinstance(cores[0], DistinctHistoryLSTM)
        self.core = (_StackedHistoryLSTM if is_recurrent else _StackedWindowNetwork)(cores)
        self.options = actors[0].parts[1]
        in_keys: list[Any] = self.core.in_keys
        out_keys: list[Any] = [*self.core.out_keys, "action", "action_log_prob"]
        self.in_keys, self.out_keys = in_keys, out_keys
        self.streams = streams

    @property
    def parts(self) -> tuple[Any, dict[str, Any]]:
        return self.core, self.options

    @property
    def runs(self) -> nn.ModuleList:
        return self.core.cells

    def log_prob(self, steps: TensorDictBase) -> Callable[[], Tensor]:
        with set_recurrent_mode(True), torch.no_grad():
            distribution, found = self.read(steps)
            places, pasts = distribution.places(steps["action"]), found.pasts

        def evaluate() -> Tensor:
            if pasts is None:
                with set_recurrent_mode(True):
                    return self.read(steps)[0].log_prob_at(places)
            core: Any = self.core
            return TupleCategorical(core.read_out(pasts), **self.options).log_prob_at(places)

        return evaluate

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write logits, states, action and log-probability."""
        distribution, read = self.read(tensordict)
        self.core.write(tensordict, read)
        sizes = self._count_rows(tensordict)
        action = distribution.choose(self.streams.uniform(sizes, tensordict["logits"]))
        tensordict.set("action", action)
        return tensordict.set("action_log_prob", distribution.log_prob(action))


class _StackedHistoryLSTM(DistinctHistoryLSTM):
    """The LSTM and the readout of each run. A symbol says which run it belongs to."""

    cells: Any
    """Cell and readout of each run."""

    def __init__(self, cores: Sequence[DistinctHistoryLSTM]) -> None:
        first = cores[0]
        super().__init__(
            first.num_classes,
            first.hidden_size,
            in_keys=first.input_keys,
            out_key=str(first.out_keys[0]),
        )
        del self.cell, self.readout
        in_keys: list[Any] = [*self.in_keys, "run"]
        self.in_keys = in_keys
        # Not the cores: an environment would carry the states of each.
        self.cells = nn.ModuleList(nn.ModuleList([core.cell, core.readout]) for core in cores)

    def read_symbols(self, tensordict: TensorDictBase) -> Tensor:
        return super().read_symbols(tensordict) + self.num_symbols * tensordict.get("run")

    def find_histories(
        self, symbols: Tensor, starts: Tensor, mask: Tensor | None, first_hashes: Tensor | None
    ) -> Histories:
        run, size = symbols // self.num_symbols, self.num_symbols
        hashes = hash_histories(symbols % size, starts, num_symbols=size, first_hashes=first_hashes)
        # Nodes are ordered by their hashes: now by run, and within a run as if it were alone.
        run_first = (hashes >> BITS_OF_RUN) + (run << (64 - BITS_OF_RUN))
        histories = distinct_histories(run_first, starts, mask)
        num_steps, num_rows, num_runs = *symbols.shape, len(self.cells)
        place = histories.rows // num_rows * num_runs + run.flatten()[histories.rows]
        sizes = place.bincount(minlength=num_steps * num_runs).view(num_steps, -1).tolist()
        return histories._replace(sizes=sizes)

    def project(self, symbols: Tensor) -> Tensor:
        run, own = symbols // self.num_symbols, symbols % self.num_symbols
        parts = own.split(_count(run, self.cells))
        return torch.cat(
            [
                self.project_by_cell(cell, part)
                for (cell, _), part in zip(self.cells, parts, strict=True)
            ]
        )

    @property
    def recurrent_weights(self) -> Sequence[Tensor]:
        return [cell.weight_hh for cell, _ in self.cells]

    def read_out(self, h: Tensor, symbols: Tensor) -> Tensor:
        run = symbols // self.num_symbols
        order = run.argsort(stable=True)
        parts = take_rows(h, order).split(_count(run, self.cells))
        outputs = [readout(own) for (_, readout), own in zip(self.cells, parts, strict=True)]
        return take_rows(torch.cat(outputs), order.argsort())


class _StackedWindowNetwork(DistinctWindowNetwork):
    """The window network of each run. A window says which run it belongs to."""

    cells: Any
    """The network of each run."""

    def __init__(self, cores: Sequence[DistinctWindowNetwork]) -> None:
        first = cores[0]
        super().__init__(
            first.num_classes,
            nn.Identity(),
            first.window,
            in_keys=first.input_keys,
            out_key=str(first.out_keys[0]),
        )
        in_keys: list[Any] = [*self.in_keys, "run"]
        self.in_keys = in_keys
        self.cells = nn.ModuleList(core.network for core in cores)
        self.num_windows *= len(cores)

    def read_symbols(self, tensordict: TensorDictBase) -> Tensor:
        return super().read_symbols(tensordict) + self.num_symbols * tensordict.get("run")

    def find_windows(self, symbols: Tensor, starts: Tensor, past: Tensor | None) -> Tensor:
        run, own = symbols // self.num_symbols, symbols % self.num_symbols
        return super().find_windows(own, starts, past) + run * self.base**self.window

    def read_out(self, windows: Tensor) -> Tensor:
        run, own = windows // self.base**self.window, windows % self.base**self.window
        parts = self.classes(own).split(_count(run, self.cells))
        return torch.cat([cell(part) for cell, part in zip(self.cells, parts, strict=True)])


def _count(runs: Tensor, cells: Sequence[Any]) -> list[int]:
    """How many of each run there are."""
    return runs.bincount(minlength=len(cells)).tolist()
