"""The policies of several independent runs as one, parameters stacked along a leading dimension.

R is the number of runs. Rows come run after run, and an integer entry ``run`` says whose they are.
The runs share what does not depend on the weights, and every elementwise operation; matrix products
are made run by run, on the same rows in the same order as by a run alone, so that its numbers are
the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn import functional as F
from torchrl.modules import ProbabilisticActor

from torchrl_ecpo.groups import RUN_KEY
from torchrl_ecpo.modules.histories import Histories, distinct_histories
from torchrl_ecpo.modules.recurrent import DistinctHistoryLSTM
from torchrl_ecpo.modules.softmax import LinearSoftmax
from torchrl_ecpo.modules.tuple_policy import TupleCategorical

__all__ = ["stack_policies"]


def stack_policies(
    actors: Sequence[ProbabilisticTensorDictSequential], random_states: Sequence[Tensor]
) -> Any:
    """Put the policies of independent runs behind one.

    Args:
        actors: one for each run: R of :func:`make_tuple_policy` (with ``distinct_histories``) or of
            :func:`make_softmax_policy`. Their parameters become views of the stacked ones: an actor
            goes on showing its run as it stands.
        random_states: of the random generator that each run samples with, as
            `torch.get_rng_state` gives them.

    Returns:
        An actor with `get_dist`, whose parameters are those of `actors`, `[R, *]`, in their order.
        It reads what they read, and ``run``, and samples for each run what its own actor would. The
        states of the random generators are in its state dict.

    Raises:
        TypeError: for a policy of another kind.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> actors = [make_softmax_policy(torch.randn(5, 2)) for _ in range(3)]
        >>> actor = stack_policies(actors, [torch.get_rng_state()] * 3)
        >>> [parameter.shape for parameter in actor.parameters()]
        [torch.Size([3, 2])]
        >>> data = TensorDict({"run": torch.tensor([0, 0, 1, 2])}, batch_size=[4])
        >>> actor(data)["action"].shape
        torch.Size([4])
    """
    head = actors[0].module[0]
    core = head.module if isinstance(getattr(head, "module", None), LinearSoftmax) else head
    return _stack(core, actors, _RandomStreams(random_states))


@singledispatch
def _stack(core: nn.Module, actors: Sequence[Any], streams: _RandomStreams) -> Any:
    raise TypeError(
        "Policies of make_softmax_policy and of make_tuple_policy with distinct histories can be "
        f"stacked, got one with {type(core).__name__}: start these runs as processes of their own."
    )


class _RandomStreams(nn.Module):
    """A random generator for each run; their states are part of the state dict."""

    def __init__(self, states: Sequence[Tensor]) -> None:
        super().__init__()
        self.generators = [torch.Generator() for _ in states]
        self.set_extra_state(torch.stack(list(states)))

    def get_extra_state(self) -> Tensor:
        """The states, uint8 `[R, n]`."""
        return torch.stack([generator.get_state() for generator in self.generators])

    def set_extra_state(self, state: Tensor) -> None:
        """Go on from there."""
        for generator, own in zip(self.generators, state.cpu(), strict=True):
            generator.set_state(own.clone())  # torch reads a view from its storage's beginning

    def uniform(self, sizes: Sequence[int], like: Tensor) -> Tensor:
        """Numbers in [0, 1) for logits, `[sum(sizes), width]`: `sizes` rows of each run."""
        dtype = torch.promote_types(like.dtype, torch.float32)  # as TupleCategorical.sample
        parts = zip(sizes, self.generators, strict=True)
        draws = [torch.rand(n, like.shape[-1], generator=own, dtype=dtype) for n, own in parts]
        return torch.cat(draws).view_as(like)


def _stack_parameters(stacked: nn.Module, modules: Sequence[nn.Module]) -> None:
    """Give `stacked` the parameters of all modules, `[R, *]`, and the modules views of them."""
    for name, _ in list(modules[0].named_parameters()):
        path, _, leaf = name.rpartition(".")
        parameters = [module.get_parameter(name) for module in modules]
        whole = nn.Parameter(torch.stack([parameter.detach() for parameter in parameters]))
        setattr(stacked.get_submodule(path), leaf, whole)
        for parameter, view in zip(parameters, whole.detach(), strict=True):
            parameter.data = view


def _count(runs: Tensor, num_runs: int) -> list[int]:
    """How many rows each run has."""
    return runs.flatten().bincount(minlength=num_runs).tolist()


def _count_rows(tensordict: TensorDictBase, num_runs: int) -> list[int]:
    """How many rows of a batch each run has.

    Raises:
        ValueError: if the rows do not come run after run.
    """
    runs = tensordict.get(RUN_KEY).flatten()
    if (runs.diff() < 0).any():
        raise ValueError(f"The rows must come run after run, got {RUN_KEY!r} = {runs.tolist()}.")
    return _count(runs, num_runs)


# ------------------------------------------------------------------- the tuple policy


class _StackedHistoryLSTM(DistinctHistoryLSTM):
    """A :class:`DistinctHistoryLSTM` for each run. A symbol says which run it belongs to."""

    def __init__(self, cores: Sequence[DistinctHistoryLSTM]) -> None:
        first = cores[0]
        readout = first.readout
        if not isinstance(readout, nn.Linear):
            raise TypeError(f"readout: expected a torch.nn.Linear, got {type(readout).__name__}.")
        super().__init__(
            first.num_classes,
            first.cell.hidden_size,
            nn.Linear(readout.in_features, readout.out_features),
            in_keys=first.input_keys,
            out_key=str(first.out_keys[0]),
            state_key=first.state_keys[0].removesuffix("_h"),
            store_states=first.store_states,
        )
        in_keys: list[Any] = [*self.in_keys, RUN_KEY]
        self.in_keys = in_keys
        self.num_runs = len(cores)
        _stack_parameters(self, cores)

    def _symbols(self, tensordict: TensorDictBase) -> Tensor:
        return super()._symbols(tensordict) + self.num_symbols * tensordict.get(RUN_KEY)

    def _histories(
        self, symbols: Tensor, starts: Tensor, mask: Tensor | None, first_hashes: Tensor | None
    ) -> Histories:
        return distinct_histories(
            symbols % self.num_symbols,
            starts,
            mask,
            num_symbols=self.num_symbols,
            first_hashes=first_hashes,
            runs=symbols[0] // self.num_symbols,
            num_runs=self.num_runs,
        )

    def _project(self, symbols: Tensor) -> Tensor:
        cell, run = self.cell, symbols // self.num_symbols
        hot = self._hot(symbols % self.num_symbols) + (run * cell.input_size).unsqueeze(-1)
        columns = F.embedding_bag(hot, cell.weight_ih.mT.flatten(0, 1), mode="sum")
        parts = columns.split(_count(run, self.num_runs))
        biases = cell.bias_ih + cell.bias_hh
        return torch.cat([part + bias for part, bias in zip(parts, biases, strict=True)])

    def _read_out(self, h: Tensor, symbols: Tensor) -> Tensor:
        readout, run = self.readout, symbols // self.num_symbols
        assert isinstance(readout, nn.Linear)
        order = run.argsort(stable=True)
        parts = h.index_select(0, order).split(_count(run, self.num_runs))
        factors = zip(parts, readout.weight, readout.bias, strict=True)
        return torch.cat([F.linear(*each) for each in factors]).index_select(0, order.argsort())


class _StackedTupleActor(ProbabilisticActor):
    """Samples for each run with its own random numbers."""

    def __init__(self, actors: Sequence[Any], streams: _RandomStreams) -> None:
        core: Any = _StackedHistoryLSTM([actor.module[0] for actor in actors])
        options = actors[0].module[1].distribution_kwargs
        super().__init__(
            core,
            in_keys=["logits"],
            distribution_class=TupleCategorical,
            distribution_kwargs=options,
            return_log_prob=True,
            log_prob_key="action_log_prob",
        )
        self.core, self.streams, self.options = core, streams, options

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Write logits, states, action and log-probability."""
        tensordict = self.core(tensordict)
        logits = tensordict.get("logits")
        distribution = TupleCategorical(logits, **self.options)
        sizes = _count_rows(tensordict, self.core.num_runs)
        action = distribution.choose(self.streams.uniform(sizes, logits))
        tensordict.set("action", action)
        return tensordict.set("action_log_prob", distribution.log_prob(action))


@_stack.register
def _(core: DistinctHistoryLSTM, actors: Sequence[Any], streams: _RandomStreams) -> Any:
    return _StackedTupleActor(actors, streams)


# ----------------------------------------------------------------- the softmax policy


class _StackedCategorical:
    """One :class:`torch.distributions.Categorical` for all rows of each run."""

    def __init__(self, logits: Sequence[Tensor], sizes: list[int], shape: torch.Size) -> None:
        self.rows = [Categorical(logits=row, validate_args=False) for row in logits]
        self.sizes, self.shape = sizes, shape

    def sample(self, generators: Sequence[torch.Generator]) -> Tensor:
        """Draw int64 actions of the batch shape."""
        draws = [
            torch.multinomial(row.probs, size, replacement=True, generator=generator)
            for row, size, generator in zip(self.rows, self.sizes, generators, strict=True)
        ]
        return torch.cat(draws).view(self.shape)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability of actions of the batch shape."""
        parts = value.flatten().split(self.sizes)
        log_probs = [row.log_prob(part) for row, part in zip(self.rows, parts, strict=True)]
        return torch.cat(log_probs).view(self.shape)


class _StackedSoftmaxPolicy(TensorDictModuleBase):
    """One row of logits for each run."""

    features: Tensor

    def __init__(self, actors: Sequence[Any], streams: _RandomStreams) -> None:
        super().__init__()
        keys: list[Any] = [RUN_KEY, "action", "action_log_prob"]
        self.in_keys, self.out_keys = keys[:1], keys[1:]
        networks = [actor.module[0].module for actor in actors]
        self.theta = nn.Parameter(networks[0].theta)
        _stack_parameters(self, networks)
        self.register_buffer("features", torch.stack([network.features for network in networks]))
        self.streams = streams

    def get_dist(self, tensordict: TensorDictBase) -> _StackedCategorical:
        """The distributions of all runs."""
        logits = [each @ theta for each, theta in zip(self.features, self.theta, strict=True)]
        sizes = _count_rows(tensordict, len(logits))
        return _StackedCategorical(logits, sizes, tensordict.get(RUN_KEY).shape)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write action and log-probability."""
        distribution = self.get_dist(tensordict)
        action = distribution.sample(self.streams.generators)
        tensordict.set("action", action)
        return tensordict.set("action_log_prob", distribution.log_prob(action))


@_stack.register
def _(core: LinearSoftmax, actors: Sequence[Any], streams: _RandomStreams) -> Any:
    return _StackedSoftmaxPolicy(actors, streams)
