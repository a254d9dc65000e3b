"""A core that sees the last few inputs, and computes each distinct window once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import TensorSpec, Unbounded

from torchrl_ecpo.checks import (
    check_count,
    check_counts,
    check_integers,
    check_kind,
    described,
    values_can_be_seen,
)
from torchrl_ecpo.modules.distinct import DistinctCore, Evaluated, radix

STATE_KEY = "window"
FEW = 1024
"""So many windows are evaluated one and all."""


class DistinctWindowNetwork(DistinctCore):
    """A feed-forward network over the last inputs that computes each distinct window once.

    What a batch of trajectories has in its windows repeats: a window of one has a few dozen values
    in thousands of steps. It takes the place of :class:`DistinctHistoryLSTM`, in sampling and in
    recurrent mode (:class:`torchrl.modules.set_recurrent_mode`, whole sequences `[*B, T]`).

    - Places of the window before `is_init` are empty: the network sees -1 there.
    - With `window` = 1 (a policy without memory) nothing else is read and no state travels.
      Otherwise the inputs before the present one travel as one number, int64 `[*B, 1]`. In
      recurrent mode every sequence begins with a trajectory's first step.

    Args:
        num_classes: the number of classes of each input, in the order of the input keys and of
            their last dimensions.
        network: makes the outputs `[n, *]` of windows `[n, window, d]` (int64, the present input
            first, then those before; -1 where there is none), for example :class:`OneHotLinear`
            and what follows.
        window: how many inputs are seen, the present one among them. Default 1.
        in_keys: the integer inputs, each `[*B]` or `[*B, d]`.
        out_key: the output. Default "embed".

    Raises:
        KeyError: if `is_init` is missing, or the state of a row that continues (`window` > 1).
        ValueError: if an input is out of range or cannot be read, or if there are more than 2^62
            different windows; in recurrent mode for a sequence that begins in the middle of a
            trajectory.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import set_recurrent_mode
        >>> from torchrl_ecpo.modules import DistinctWindowNetwork, OneHotLinear
        >>> network = DistinctWindowNetwork(
        ...     [4, 3], OneHotLinear([4, 3, 4, 3], 8), 2, in_keys=["observation", "last_action"]
        ... )
        >>> data = TensorDict(
        ...     observation=torch.randint(4, (6, 10)),
        ...     last_action=torch.randint(3, (6, 10)),
        ...     is_init=(torch.arange(10) == 0).expand(6, 10).unsqueeze(-1),
        ...     batch_size=[6, 10],
        ... )
        >>> with set_recurrent_mode(True):
        ...     network(data)["embed"].shape
        torch.Size([6, 10, 8])
    """

    def __init__(
        self,
        num_classes: Sequence[int],
        network: nn.Module,
        window: int = 1,
        *,
        in_keys: Sequence[NestedKey],
        out_key: str = "embed",
    ) -> None:
        self.window = check_count("window", window)
        self.state_keys = [STATE_KEY] if self.window > 1 else []
        super().__init__(num_classes, in_keys=in_keys, out_key=out_key)
        # The digits of a window's number are its symbols, 0 for none, the present one last.
        self.base = self.num_symbols + 1
        self.num_windows = self.base**self.window
        if self.num_windows > 2**62:
            raise ValueError(
                f"window: expected at most 2^62 different windows, got {self.base}^{self.window}."
            )
        check_kind("network", network, nn.Module)
        self.network = network
        self._table: Tensor | None = None

    def state_specs(self) -> dict[NestedKey, TensorSpec]:
        """The window's past as one number, int64 `[1]`."""
        return {key: Unbounded(torch.Size((1,)), dtype=torch.int64) for key in self.state_keys}

    def evaluate(
        self,
        symbols: Tensor,
        starts: Tensor,
        mask: Tensor | None = None,
        states: Sequence[Tensor] | None = None,
    ) -> Evaluated:
        """See the base class; padded steps have the empty window."""
        windows = self.find_windows(symbols, starts, None if states is None else states[0])
        if mask is not None:
            windows = windows.masked_fill(~mask, 0)
        if self._table is not None and not self.state_keys:
            return Evaluated(windows, self._table, {})
        if self.is_tabular:
            present, nodes = self._every(windows.device), windows
        else:
            present, nodes = windows.unique(return_inverse=True)
        output = self.read_out(present) if self._table is None else self._table
        # To the next step goes all but the oldest symbol.
        kept = self.base ** (self.window - 1)
        handed_on: Any = {key: (present % kept).unsqueeze(1) for key in self.state_keys}
        return Evaluated(nodes, output, handed_on, present)

    @property
    def is_tabular(self) -> bool:
        """Whether all windows are evaluated, which costs less than to find those that occur."""
        return self.num_windows <= FEW

    def _every(self, device: torch.device) -> Tensor:
        return torch.arange(self.num_windows, device=device)

    @contextmanager
    def constant_weights(self) -> Iterator[Tensor | None]:
        """Within, the weights do not change: yields the output of all windows if it is kept."""
        if self.is_tabular:
            self._table = self.read_out(self._every(next(self.parameters()).device))
        try:
            yield self._table
        finally:
            self._table = None

    def find_windows(self, symbols: Tensor, starts: Tensor, past: Tensor | None) -> Tensor:
        """The window at each step as a number, int64 `[T, N]`.

        Of a single step it continues the past `[N, 1]`.
        """
        if past is not None and past.dtype != torch.int64:
            raise ValueError(f"window: expected int64 [*B, 1], got {described(past)}.")
        digits = windows = symbols + 1
        for _ in range(min(self.window - 1, len(symbols))):
            before = F.pad(windows[:-1], (0, 0, 1, 0)) if past is None else past.t()
            windows = digits + self.base * before.masked_fill(starts, 0)
        return windows

    def read_out(self, windows: Tensor) -> Tensor:
        """The output of each window `[n]`."""
        return self.network(self.classes(windows))

    def classes(self, windows: Tensor) -> Tensor:
        """What windows `[n]` consist of, `[n, window, d]`; -1 where they are empty."""
        sizes, weights, *_ = radix(self.num_classes, windows.device)
        places = self.base ** torch.arange(self.window, device=windows.device)
        digits = (windows.unsqueeze(-1) // places % self.base).unsqueeze(-1)
        return ((digits - 1) // weights % sizes).where(digits > 0, -1)


class OneHotLinear(nn.Linear):
    """A linear layer on the one-hot vectors of integers, as the sum of some columns.

    Args:
        num_classes: the number of classes of each integer.
        out_features: H.

    Raises:
        TypeError: if `num_classes` is no sequence.
        ValueError: for numbers of classes that are no positive integers, and for classes that are
            no integers from -1 on below those numbers.

    Examples:
        >>> import torch
        >>> from torchrl_ecpo.modules import OneHotLinear
        >>> layer = OneHotLinear([4, 3], 8)
        >>> layer(torch.tensor([[3, 0], [1, -1]])).shape
        torch.Size([2, 8])
    """

    offsets: Tensor
    last: Tensor

    def __init__(self, num_classes: Sequence[int], out_features: int) -> None:
        sizes = torch.tensor(check_counts("num_classes", num_classes))
        super().__init__(int(sizes.sum()), out_features)
        self.register_buffer("offsets", sizes.cumsum(0) - sizes, persistent=False)
        self.register_buffer("last", sizes - 1, persistent=False)

    def forward(self, classes: Tensor) -> Tensor:
        """From int64 `[n, *]`, one of each of `num_classes`, to `[n, H]`; -1 is the zero vector."""
        if classes.ndim < 2 or classes.shape[1:].numel() != len(self.last):
            raise ValueError(
                f"classes: expected int64 [n, *] of {len(self.last)} integers in a row, one for "
                f"each of num_classes, got {described(classes)}."
            )
        if classes.dtype != torch.bool:
            check_integers("classes", classes)
        classes = classes.flatten(1).long()
        if values_can_be_seen() and ((classes < -1) | (classes > self.last)).any():
            raise ValueError(
                f"classes: expected integers from -1 to {self.last.tolist()}, got values from "
                f"{classes.amin(0).tolist()} to {classes.amax(0).tolist()}."
            )
        hot = (classes + self.offsets).where(classes >= 0, self.in_features)
        columns = F.pad(self.weight.t(), (0, 0, 0, 1))  # the last one is of -1
        return F.embedding_bag(hot, columns, mode="sum") + self.bias
