"""A recurrent core that computes each distinct history once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import TensorSpec, Unbounded

from torchrl_ecpo.checks import check_count, check_kind
from torchrl_ecpo.modules.distinct import DistinctCore, Evaluated, radix
from torchrl_ecpo.modules.histories import (
    Histories,
    LSTMOverHistories,
    distinct_histories,
    hash_histories,
    hash_states,
)

STATE_KEYS = ("recurrent_state_h", "recurrent_state_c")  # each `[*B, 1, H]`, as with LSTMModule


class DistinctHistoryLSTM(DistinctCore):
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

    state_keys = STATE_KEYS

    def __init__(
        self,
        num_classes: Sequence[int],
        hidden_size: int = 128,
        readout: nn.Module | None = None,
        *,
        in_keys: Sequence[NestedKey],
        out_key: str = "embed",
    ) -> None:
        super().__init__(num_classes, in_keys=in_keys, out_key=out_key)
        self.hidden_size = check_count("hidden_size", hidden_size)
        self.cell = nn.LSTMCell(sum(self.num_classes), self.hidden_size)
        self.readout = nn.Identity() if readout is None else readout
        check_kind("readout", self.readout, nn.Module)

    def state_specs(self) -> dict[NestedKey, TensorSpec]:
        """H and c, `[1, H]` each."""
        dtype = next(self.parameters()).dtype
        return dict.fromkeys(STATE_KEYS, Unbounded(torch.Size((1, self.hidden_size)), dtype=dtype))

    def evaluate(
        self,
        symbols: Tensor,
        starts: Tensor,
        mask: Tensor | None = None,
        states: Sequence[Tensor] | None = None,
    ) -> Evaluated:
        """See the base class; padded steps have a node of zeros."""
        first_hashes = None if states is None else hash_states(*states)
        histories = self.find_histories(symbols, starts, mask, first_hashes)
        last_symbols = symbols.flatten()[histories.rows]
        present, node_symbols = last_symbols.unique(return_inverse=True)
        lstm = LSTMOverHistories
        past_h, past_c = states or (None, None)
        h, c, _ = (lstm.apply if torch.is_grad_enabled() else lstm.forward)(
            self.project(present),
            past_h,
            past_c,
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
        handed_on: Any = {key: x.unsqueeze(1) for key, x in zip(STATE_KEYS, (h, c), strict=True)}
        return Evaluated(nodes, output, handed_on)

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
        return self.project_by_cell(self.cell, symbols)

    @property
    def recurrent_weights(self) -> Sequence[Tensor]:
        """weight_hh `[4H, H]` of each cell."""
        return (self.cell.weight_hh,)

    def read_out(self, h: Tensor, symbols: Tensor) -> Tensor:
        """The output of each node, from its state `[n, H]` and last symbol `[n]`."""
        return self.readout(h)

    def project_by_cell(self, cell: nn.LSTMCell, symbols: Tensor) -> Tensor:
        """The same by a given cell. A one-hot product is a sum of columns."""
        sizes, weights, offsets, *_ = radix(self.num_classes, symbols.device)
        hot = symbols.unsqueeze(-1) // weights % sizes + offsets
        columns = F.embedding_bag(hot, cell.weight_ih.t().contiguous(), mode="sum")
        return columns + (cell.bias_ih + cell.bias_hh)
