"""What the cores of the tuple policies share: categorical inputs, each distinct past once.

Shapes: N rows of T steps; n distinct pasts ("nodes") among them; S input tuples ("symbols").
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from math import prod
from typing import Any, NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import TensorDictPrimer
from torchrl.modules import recurrent_mode

from torchrl_ecpo.checks import (
    check_counts,
    check_integers,
    check_keys,
    check_mask,
    names_entries,
)


class Evaluated(NamedTuple):
    """The distinct pasts of a batch, and what a core makes of them."""

    nodes: Tensor
    """Which past each place of the batch has, int64 `[T, N]`."""
    output: Tensor
    """`[n, *]`."""
    states: Mapping[NestedKey, Tensor]
    """What each hands to the next step, `[n, *]`; read in sampling."""
    pasts: Tensor | None = None
    """Each as a number `[n]`, of which the core's `read_out` makes the output, if it can."""


class DistinctCore(TensorDictModuleBase):
    """Base class: reads categorical inputs, and evaluates each distinct past once.

    A core implements :meth:`evaluate`, and says in :meth:`state_specs` what travels from step to
    step. See :class:`DistinctHistoryLSTM` and :class:`DistinctWindowNetwork`.
    """

    state_keys: Sequence[NestedKey] = ()
    """What travels from step to step; `is_init`, which says where it starts, is read with it."""

    def __init__(
        self,
        num_classes: Sequence[int],
        *,
        in_keys: Sequence[NestedKey],
        out_key: str,
    ) -> None:
        super().__init__()
        self.num_classes = check_counts("num_classes", num_classes)
        self.num_symbols = prod(self.num_classes)
        if not self.num_classes or self.num_symbols > 2**31:
            raise ValueError(
                "num_classes: expected one or more numbers, with a product of at most 2^31, got "
                f"{self.num_classes}."
            )
        self.input_keys = check_keys("in_keys", in_keys)
        starts = ["is_init"] if self.state_keys else []
        all_keys: list[Any] = [*self.input_keys, *self.state_keys, *starts]
        self.in_keys = all_keys
        out_keys: list[Any] = [*check_keys("out_key", [out_key])]
        out_keys += [("next", key) for key in self.state_keys]
        self.out_keys = out_keys

    @abstractmethod
    def evaluate(
        self,
        symbols: Tensor,
        starts: Tensor,
        mask: Tensor | None = None,
        states: Sequence[Tensor] | None = None,
    ) -> Evaluated:
        """Evaluate the distinct pasts of sequences, on plain tensors.

        Args:
            symbols: int64 `[T, N]`, the inputs of a step as one number.
            starts: bool `[T, N]`, True where a sequence has no past.
            mask: bool `[T, N]`, False at padded steps. Default None: all are real.
            states: what rows continue from, `[N, *]` by `state_keys`. Default None: all start.

        Returns:
            The node at each place, and of each node the output and the states.
        """

    @contextmanager
    def constant_weights(self) -> Iterator[Tensor | None]:
        """Within, the weights do not change; yields the output of all pasts if that is known."""
        yield None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the output into `[*B]`, or `[*B, T]` in recurrent mode; in sampling next states."""
        return self.write(tensordict, self.read(tensordict))

    def write(self, tensordict: TensorDictBase, found: Evaluated) -> TensorDictBase:
        """Write what was evaluated at its places."""
        tensordict.set(self.out_keys[0], take_rows(found.output, found.nodes))
        for key, value in found.states.items():
            tensordict.set(("next", key), take_rows(value, found.nodes))
        return tensordict

    @names_entries
    def read(self, tensordict: TensorDictBase) -> Evaluated:
        """Evaluate a batch; the nodes have its shape, the states are those that it hands on."""
        shape = tensordict.shape
        symbols = self.read_symbols(tensordict)
        starts = self._starts(tensordict)
        if recurrent_mode():
            if not shape:
                raise ValueError(
                    "tensordict: expected a batch shape [*B, T], time last, in recurrent mode, got "
                    "none."
                )
            mask = tensordict.get(("collector", "mask"), None)
            if mask is not None:
                mask = check_mask(("collector", "mask"), mask, shape)
                starts = starts | ~mask
            symbols, starts, mask = (_time_first(x) for x in (symbols, starts, mask))
            if not starts[0].all():
                raise ValueError(
                    "is_init: expected every sequence to begin with a trajectory's first step, "
                    "since states are not stored, and some do not; keep trajectories whole."
                )
            found = self.evaluate(symbols, starts, mask)
            return found._replace(nodes=found.nodes.t().reshape(shape), states={})
        ended = tensordict.get("done", None)
        if ended is not None:
            ended = ended.reshape(shape)
            starts, symbols = starts | ended, symbols.masked_fill(ended, 0)
        symbols, starts = symbols.reshape(1, -1), starts.reshape(1, -1)
        found = self.evaluate(symbols, starts, states=self._states(tensordict, starts))
        return found._replace(nodes=found.nodes.view(shape))

    def read_symbols(self, tensordict: TensorDictBase) -> Tensor:
        """The input tuple as one number, int64 `[*B]`."""
        inputs = [tensordict.get(key) for key in self.input_keys]
        for key, entry in zip(self.input_keys, inputs, strict=True):
            if isinstance(entry, Tensor) and entry.dtype != torch.bool:  # others are told below
                check_integers(key, entry)
        ndim = tensordict.ndim
        classes = torch.cat([x if x.ndim > ndim else x.unsqueeze(-1) for x in inputs], -1)
        if classes.shape[-1] != len(self.num_classes):
            raise ValueError(
                f"{self.input_keys}: expected {len(self.num_classes)} integers in all, one for "
                f"each of num_classes, got {classes.shape[-1]}."
            )
        _, weights, _, first, last = radix(self.num_classes, classes.device)
        if not torch.equal(torch.clamp(classes, first, last), classes):
            flat = classes.reshape(-1, len(self.num_classes))
            raise ValueError(
                f"{self.input_keys}: expected classes in [0, n) for n in {self.num_classes}, got "
                f"values from {flat.amin(0).tolist()} to {flat.amax(0).tolist()}."
            )
        return (classes * weights).sum(-1)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that carries the states from step to step; collectors append it."""
        return _TransientPrimer(self.state_specs(), expand_specs=True)

    def state_specs(self) -> dict[NestedKey, TensorSpec]:
        """What travels from step to step, by `state_keys`."""
        return {}

    def _starts(self, tensordict: TensorDictBase) -> Tensor:
        """Where sequences have no past, bool `[*B]`."""
        if not self.state_keys:
            device = tensordict.get(self.input_keys[0]).device
            return torch.ones(tensordict.shape, dtype=torch.bool, device=device)
        is_init = tensordict.get("is_init", None)
        if is_init is None:
            raise KeyError(
                "is_init: expected the key that marks a trajectory's first step, found none among "
                f"{sorted(map(str, tensordict.keys()))}; append torchrl.envs.InitTracker() to the "
                "environment."
            )
        return is_init.reshape(tensordict.shape)

    def _states(self, tensordict: TensorDictBase, starts: Tensor) -> list[Tensor] | None:
        """The states `[N, *]` that the rows of a step continue from; None where all start."""
        states = [tensordict.get(key, None) for key in self.state_keys]
        present = [state for state in states if state is not None]
        if present and len(present) == len(states):
            return [state.reshape(-1, state.shape[-1]) for state in present]
        if not states or starts.all():
            return None
        raise KeyError(
            f"{self.state_keys}: expected the states of rows that continue a trajectory, found "
            "none; append this module's make_tensordict_primer() to the environment."
        )


class _TransientPrimer(TensorDictPrimer):
    """A primer whose entries go from step to step, and not into the collected data."""

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, tensordict_: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        self._drop(tensordict)
        return tensordict, tensordict_

    def transform_fake_tensordict(self, fake_tensordict: TensorDictBase) -> TensorDictBase:
        return self._drop(fake_tensordict)

    def _drop(self, tensordict: TensorDictBase) -> TensorDictBase:
        for key in cast(Composite, self.primers).keys(True, True):
            tensordict.pop(key, None)
            tensordict.pop(("next", key), None)
        return tensordict


@lru_cache(maxsize=64)
def radix(num_classes: tuple[int, ...], device: torch.device) -> tuple[Tensor, ...]:
    """Bases and weights of input tuples as numbers; where each digit's one-hot vector starts.

    Then each digit's least and greatest value.
    """
    sizes = torch.tensor(num_classes, device=device)
    weights = sizes.flip(0).cumprod(0).flip(0) // sizes
    return sizes, weights, sizes.cumsum(0) - sizes, torch.zeros_like(sizes), sizes - 1


def _time_first(x: Tensor | None) -> Any:
    """`[*B, T]` to `[T, N]`."""
    return None if x is None else x.reshape(-1, x.shape[-1]).t().contiguous()


def take_rows(values: Tensor, index: Tensor) -> Tensor:
    """`values[index]` along the first dimension, `[*index.shape, *]`."""
    # Quicker than indexing, above all backwards.
    return values.index_select(0, index.reshape(-1)).view(index.shape + values.shape[1:])
