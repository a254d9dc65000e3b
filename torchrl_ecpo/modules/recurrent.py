"""A recurrent core that computes each distinct history once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import prod
from typing import Any, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import Composite, Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules import recurrent_mode

from torchrl_ecpo.checks import (
    check_count,
    check_counts,
    check_keys,
    check_kind,
    check_mask,
    names_entries,
)
from torchrl_ecpo.modules.histories import (
    Histories,
    LSTMOverHistories,
    distinct_histories,
    hash_histories,
    hash_states,
)

__all__ = ["DistinctHistoryLSTM"]

STATE_KEYS = ("recurrent_state_h", "recurrent_state_c")  # each `[*B, 1, H]`, as with LSTMModule


class DistinctHistoryLSTM(TensorDictModuleBase):
    """An LSTM over categorical inputs that computes each distinct history once.

    It takes the place of :class:`torchrl.modules.LSTMModule` on one-hot inputs, with the same
    numbers. Rollouts of one problem instance begin alike, so at each step many rows of a batch have
    seen the same inputs since their start; their LSTM states are equal. The rows are de-duplicated,
    the cell and the readout run on the distinct ones alone, and the result is gathered back: in
    sampling, one step at a time, and in recurrent mode
    (:class:`torchrl.modules.set_recurrent_mode`) over whole sequences `[*B, T]`.

    - Rows with `is_init` start from the zero state, also in the middle of a sequence.
    - Sampling: the state of each row travels in the tensordict, as with `LSTMModule`, and rows are
      compared by the state's bits. So nothing is remembered between calls: rows may be dropped,
      reordered or moved to another process, and weights may change. Rows whose root `done` is set
      have ended: they share one zero state.
    - Recurrent mode: every sequence begins with a trajectory's first step. Padded steps, by
      `("collector", "mask")` where it is there, cost nothing and give zeros. Gradients are exact
      (once: no second derivatives). No states are written, nor do they stay in collected data, of
      which they would be the most: the update needs none.

    Args:
        num_classes: the number of classes of each input, in the order of the input keys and of
            their last dimensions.
        hidden_size: H. Default 128 (the UREX paper's).
        readout: a module that is applied to each distinct output `[n, H]`, for example a linear
            layer to logits. Default None: the output is the LSTM's.
        in_keys: the integer inputs, each `[*B]` or `[*B, d]`.
        out_key: the output. Default "embed".
        device: of the parameters.
        dtype: of the parameters.

    Attributes:
        cell: the `torch.nn.LSTMCell` that holds the parameters, initialised by PyTorch: uniform in
            +-1/sqrt(H).

    Raises:
        KeyError: if `is_init` is missing, or the state of a row that continues.
        ValueError: if an input is out of range or cannot be read; in recurrent mode without a time
            dimension, or for a sequence that begins in the middle of a trajectory.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import set_recurrent_mode
        >>> from torchrl_ecpo.modules import DistinctHistoryLSTM
        >>> lstm = DistinctHistoryLSTM([4, 3], 8, in_keys=["observation", "previous_action"])
        >>> data = TensorDict(
        ...     observation=torch.randint(4, (6, 10)),
        ...     previous_action=torch.randint(3, (6, 10)),
        ...     is_init=(torch.arange(10) == 0).expand(6, 10).unsqueeze(-1),
        ...     batch_size=[6, 10],
        ... )
        >>> with set_recurrent_mode(True):
        ...     lstm(data)["embed"].shape
        torch.Size([6, 10, 8])
    """

    def __init__(
        self,
        num_classes: Sequence[int],
        hidden_size: int = 128,
        readout: nn.Module | None = None,
        *,
        in_keys: Sequence[NestedKey],
        out_key: str = "embed",
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        self.num_classes = check_counts("num_classes", num_classes)
        self.num_symbols = prod(self.num_classes)
        if self.num_symbols > 2**31:
            raise ValueError(
                "num_classes: expected numbers with a product of at most 2^31, got "
                f"{self.num_classes}."
            )
        self.input_keys = check_keys("in_keys", in_keys)
        all_keys: list[Any] = [*self.input_keys, *STATE_KEYS, "is_init"]
        self.in_keys = all_keys
        out_keys: list[Any] = [*check_keys("out_key", [out_key])]
        out_keys += [("next", key) for key in STATE_KEYS]
        self.out_keys = out_keys
        self.hidden_size = check_count("hidden_size", hidden_size)
        self.cell = nn.LSTMCell(sum(self.num_classes), self.hidden_size, device=device, dtype=dtype)
        self.readout = readout if readout is not None else nn.Identity()
        check_kind("readout", self.readout, nn.Module)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that lets an environment carry the states from step to step.

        Returns:
            A :class:`torchrl.envs.TensorDictPrimer`; collectors append it by themselves.
        """
        dtype = next(self.parameters()).dtype
        spec = Unbounded(torch.Size((1, self.hidden_size)), dtype=dtype)
        return _TransientPrimer(dict.fromkeys(STATE_KEYS, spec), expand_specs=True)

    @names_entries
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the output; in sampling also the next states.

        Args:
            tensordict: `[*B]`, or `[*B, T]` in recurrent mode.

        Returns:
            The same tensordict.
        """
        is_init = tensordict.get("is_init", None)
        if is_init is None:
            raise KeyError(
                "is_init: expected the key that marks a trajectory's first step, found none among "
                f"{sorted(map(str, tensordict.keys()))}; append torchrl.envs.InitTracker() to the "
                "environment."
            )
        shape = tensordict.shape
        symbols, starts = self.read_symbols(tensordict), is_init.reshape(shape)
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
            nodes, output, *_ = self.evaluate(symbols, starts, mask)
            return tensordict.set(self.out_keys[0], _rows(output, nodes.t(), shape))

        ended = tensordict.get("done", None)
        if ended is not None:
            ended = ended.reshape(shape)
            starts, symbols = starts | ended, symbols.masked_fill(ended, 0)
        symbols, starts = symbols.reshape(1, -1), starts.reshape(1, -1)
        nodes, *values = self.evaluate(symbols, starts, states=self._states(tensordict, starts))
        nodes = nodes.view(-1)
        for key, value, ndim in zip(self.out_keys, values, (0, 1, 1), strict=True):
            tensordict.set(key, value.index_select(0, nodes).view(*shape, *(1,) * ndim, -1))
        return tensordict

    def evaluate(
        self,
        symbols: Tensor,
        starts: Tensor,
        mask: Tensor | None = None,
        states: tuple[Tensor, Tensor] | None = None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Evaluate the distinct histories of sequences, on plain tensors.

        Args:
            symbols: int64 `[T, N]`, the inputs of a step as one number.
            starts: bool `[T, N]`, True where a sequence starts from the zero state.
            mask: bool `[T, N]`, False at padded steps. Default None: all are real.
            states: h and c `[N, H]` that rows continue from. Default None: all start.

        Returns:
            The node at each place, `[T, N]`; each node's output, h and c, `[n, *]`.
        """
        first_hashes = None if states is None else hash_states(*states)
        histories = self.find_histories(symbols, starts, mask, first_hashes)
        last_symbols = symbols.flatten()[histories.rows]
        present, node_symbols = last_symbols.unique(return_inverse=True)
        lstm = LSTMOverHistories
        h, c, _ = (lstm.apply if torch.is_grad_enabled() else lstm.forward)(
            self.project(present),
            *((None, None) if states is None else states),
            node_symbols,
            histories,
            *self.recurrent_weights,
        )
        output = self.read_out(h, last_symbols)
        nodes = histories.nodes
        if mask is not None:
            # Node -1, the padding, is the last row.
            output = torch.cat([output, output.new_zeros(1, output.shape[-1])])
            nodes = nodes.masked_fill(nodes < 0, len(output) - 1)
        return nodes, output, h, c

    # ------------------------------------------------------------------- parts of evaluate

    def read_symbols(self, tensordict: TensorDictBase) -> Tensor:
        """The input tuple as one number, int64 `[*B]`."""
        inputs = [tensordict.get(key) for key in self.input_keys]
        ndim = tensordict.ndim
        classes = torch.cat([x if x.ndim > ndim else x.unsqueeze(-1) for x in inputs], -1)
        if classes.shape[-1] != len(self.num_classes):
            raise ValueError(
                f"{self.input_keys}: expected {len(self.num_classes)} integers in all, one for "
                f"each of num_classes, got {classes.shape[-1]}."
            )
        _, weights, _, first, last = _radix(self.num_classes, classes.device)
        if not torch.equal(torch.clamp(classes, first, last), classes):
            flat = classes.reshape(-1, len(self.num_classes))
            raise ValueError(
                f"{self.input_keys}: expected classes in [0, n) for n in {self.num_classes}, got "
                f"values from {flat.amin(0).tolist()} to {flat.amax(0).tolist()}."
            )
        return (classes * weights).sum(-1)

    def find_histories(
        self, symbols: Tensor, starts: Tensor, mask: Tensor | None, first_hashes: Tensor | None
    ) -> Histories:
        """The distinct histories of symbols `[T, N]`."""
        hashes = hash_histories(
            symbols, starts, num_symbols=self.num_symbols, first_hashes=first_hashes
        )
        return distinct_histories(hashes, starts, mask)

    def project(self, symbols: Tensor) -> Tensor:
        """The input's part of the gates for symbols `[S]`, with the biases: `[S, 4H]`."""
        return self.project_by(self.cell, symbols)

    @property
    def recurrent_weights(self) -> Sequence[Tensor]:
        """weight_hh `[4H, H]` of each cell."""
        return (self.cell.weight_hh,)

    def read_out(self, h: Tensor, symbols: Tensor) -> Tensor:
        """The output of each node, from its state `[n, H]` and last symbol `[n]`."""
        return self.readout(h)

    def project_by(self, cell: nn.LSTMCell, symbols: Tensor) -> Tensor:
        """The same by a given cell. A one-hot product is a sum of columns."""
        sizes, weights, offsets, *_ = _radix(self.num_classes, symbols.device)
        hot = symbols.unsqueeze(-1) // weights % sizes + offsets
        columns = F.embedding_bag(hot, cell.weight_ih.t().contiguous(), mode="sum")
        return columns + (cell.bias_ih + cell.bias_hh)

    def _states(self, tensordict: TensorDictBase, starts: Tensor) -> tuple[Tensor, Tensor] | None:
        """The states `[N, H]` that the rows of a step continue from; None where all start."""
        h, c = (tensordict.get(key, None) for key in STATE_KEYS)
        if h is not None and c is not None:
            return h.reshape(-1, h.shape[-1]), c.reshape(-1, c.shape[-1])
        if starts.all():
            return None
        raise KeyError(
            f"{STATE_KEYS}: expected the states of rows that continue a trajectory, found "
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
def _radix(num_classes: tuple[int, ...], device: torch.device) -> tuple[Tensor, ...]:
    """Bases and weights of input tuples as numbers; where each digit's one-hot vector starts.

    Then each digit's least and greatest value.
    """
    sizes = torch.tensor(num_classes, device=device)
    weights = sizes.flip(0).cumprod(0).flip(0) // sizes
    return sizes, weights, sizes.cumsum(0) - sizes, torch.zeros_like(sizes), sizes - 1


def _time_first(x: Tensor | None) -> Any:
    """`[*B, T]` to `[T, N]`."""
    return None if x is None else x.reshape(-1, x.shape[-1]).t().contiguous()


def _rows(values: Tensor, index: Tensor, shape: Sequence[int]) -> Tensor:
    """`values[index]` along the first dimension, `[*shape, *]`."""
    # Quicker than indexing, above all backwards.
    return values.index_select(0, index.reshape(-1)).reshape(*shape, -1)
