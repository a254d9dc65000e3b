"""Distinct histories: which rows of a batch share a past, and an LSTM over those alone.

Shapes: N rows of T steps; n distinct histories ("nodes"); H hidden units. Nodes are ordered by
step, within a step by their hash; a node's parent is the history that it extends by one step.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_PADDING = torch.iinfo(torch.int64).max


def mix(x: Tensor) -> Tensor:
    """Scramble int64 values: the (bijective) finaliser of splitmix64, by Steele et al. (2014)."""
    x = _fold(x + 0x1E3779B97F4A7C15, 30) * -0x40A7B892E31B1A47
    return _fold(_fold(x, 27) * -0x6B2FB644ECCEEE15, 31)


def _fold(x: Tensor, bits: int) -> Tensor:
    """Add the upper bits to the lower ones, reversibly."""
    return x ^ ((x >> bits) & ((1 << (64 - bits)) - 1))


def hash_states(*states: Tensor) -> Tensor:
    """Hash recurrent states `[N, H]` by their bits: int64 `[N]`, equal for equal rows alone.

    Multilinear hashing modulo 2^64 with odd multipliers: two states that differ in one word never
    collide; two that differ in several do with probability 2^-(64 - z), z the trailing zeros common
    to all differences of words. States of a network differ in their lowest bits, z = 0: for 400
    rows, 8e4 pairs, that makes 4e-15 a step. Where only signs differ, z is 22.
    """
    total = torch.zeros((), dtype=torch.int64, device=states[0].device)
    for i, state in enumerate(states):
        bits = state.detach().contiguous()
        aligned = bits.shape[-1] * bits.element_size() % 8 == 0
        if len(bits) == 1 or bits.storage_offset() * bits.element_size() % 8:
            # A row of a wider tensor passes for contiguous, wherever it begins.
            bits = bits.clone(memory_format=torch.contiguous_format)
        bits = _fold(bits.view(torch.int64), 41) if aligned else bits.view(torch.uint8)
        total = total + (bits * _multipliers(bits.shape[-1], i, bits.device)).sum(-1)
    return total


@lru_cache(maxsize=16)
def _multipliers(size: int, stream: int, device: torch.device) -> Tensor:
    return mix(torch.arange(size, device=device) + (stream << 32)) | 1


def hash_histories(
    symbols: Tensor, starts: Tensor, *, num_symbols: int, first_hashes: Tensor | None = None
) -> Tensor:
    """Hash the history of each row at each step, the sequence of symbols since its last start.

    A hash is the sum, modulo 2^64, of scrambled (step, symbol) pairs: two different histories at
    one step collide with probability 2^-64, so a batch of 400 rows and 66 steps, 5e6 pairs, does
    with 3e-13.

    Args:
        symbols: int64 `[T, N]` in [0, num_symbols).
        starts: bool `[T, N]`, True where a sequence starts from the zero state.
        num_symbols: the number of different symbols.
        first_hashes: int64 `[N]`, the hash of the state that a row continues from where its first
            step is no start. None where every row starts at its first step.

    Returns:
        int64 `[T, N]`.
    """
    step = torch.arange(len(symbols), device=symbols.device).unsqueeze(1)
    terms = mix(step * num_symbols + symbols)
    if first_hashes is not None:
        terms[0] += first_hashes.masked_fill(starts[0], 0)
    hashes = terms.cumsum(0)
    if starts[1:].any():
        start = torch.where(starts, step, 0).cummax(0).values
        hashes = hashes - (hashes - terms).gather(0, start)
    return hashes


class _Block(NamedTuple):
    """The nodes of a step."""

    nodes: slice
    parents: Tensor | None
    """None where all start from the zero state."""
    continues: Tensor | None
    """A bool column that is False for those that start from the zero state, None if none does."""
    sizes: list[int] | None


class Histories(NamedTuple):
    """The distinct histories of a batch.

    Attributes:
        counts: the number of nodes at each step.
        starts: how many of them start from the zero state.
        parents: int64 `[n]`, each node's parent as an index into the nodes of the step before (for
            the first step: into the initial states); -1 for a node that starts from the zero state.
        rows: int64 `[n]`, one place of each node in the batch, flattened from `[T, N]`.
        nodes: int64 `[T, N]`, the node at each place of the batch; -1 at padded steps.
        sizes: where there are several cells, how many of a step's nodes each has, one cell's after
            the other's.
    """

    counts: list[int]
    starts: list[int]
    parents: Tensor
    rows: Tensor
    nodes: Tensor
    sizes: list[list[int]] | None = None

    def blocks(self) -> list[_Block]:
        """Cut the nodes into steps, those that have nodes."""
        blocks, first = [], 0
        sizes = self.sizes or [None] * len(self.counts)
        for count, starts, size in zip(self.counts, self.starts, sizes, strict=True):
            block = slice(first, first + count)
            first += count
            if starts == count:
                blocks.append(_Block(block, None, None, size))
                continue
            parent = self.parents[block]
            continues = (parent >= 0).unsqueeze(1) if starts else None
            parent = parent.clamp(min=0) if starts else parent
            blocks.append(_Block(block, parent, continues, size))
        return [block for count, block in zip(self.counts, blocks, strict=True) if count]


def distinct_histories(hashes: Tensor, starts: Tensor, mask: Tensor | None = None) -> Histories:
    """Find the distinct histories of a batch of sequences.

    Args:
        hashes: int64 `[T, N]`, equal for equal histories: :func:`hash_histories`.
        starts: bool `[T, N]`, True where a sequence starts from the zero state. Row i continues
            from initial state i where its first step is no start.
        mask: bool `[T, N]`, False at padded steps; None where all are real.

    Returns:
        The histories.
    """
    num_steps, num_rows = hashes.shape
    step = torch.arange(num_steps, device=hashes.device).unsqueeze(1)
    if mask is not None:
        hashes = hashes.masked_fill(~mask, _PADDING)
    hashes, order = hashes.sort(1)
    new = hashes != _PADDING
    new[:, 1:] &= hashes[:, 1:] != hashes[:, :-1]
    # Nodes are numbered within their step first, as parents are.
    nodes = torch.empty_like(order).scatter_(1, order, new.cumsum(1) - 1)
    if mask is not None:
        nodes.masked_fill_(~mask, -1)
    before = torch.cat([torch.arange(num_rows, device=nodes.device).unsqueeze(0), nodes[:-1]])
    rows = (order + step * num_rows)[new]
    parents = before.masked_fill_(starts, -1).flatten()[rows]

    counts = new.sum(1)
    started = torch.zeros_like(counts).index_add_(0, rows // num_rows, (parents < 0).long())
    first = (counts.cumsum(0) - counts).unsqueeze(1)
    nodes = torch.where(nodes < 0, nodes, nodes + first)
    return Histories(counts.tolist(), started.tolist(), parents, rows, nodes)


class LSTMOverHistories(torch.autograd.Function):
    """An LSTM layer over distinct histories: one cell evaluation for each node.

    Equal to `torch.nn.LSTM` on each row. It has its own backward because autograd through a loop
    over steps takes about twice as long: it keeps every intermediate, and fresh memory is dear.

    `apply(projections, h_0, c_0, symbols, histories, *weights) -> (h, c, gates)`

    - projections `[S, 4H]`: the input's part of the gates for each symbol, biases included, in
      PyTorch's order (input, forget, cell, output);
    - h_0, c_0 `[N, H]`: the initial states, None where every row starts from zero;
    - symbols int64 `[n]`: the symbol that each node ends with, as a row of `projections`;
    - weights: weight_hh `[4H, H]`, of each cell if there are several (`histories.sizes`);
    - h, c `[n, H]`: the state after each node; gates `[n, 4H]`: activations, not differentiable.
    """

    @staticmethod
    def forward(
        projections: Tensor,
        h_0: Tensor | None,
        c_0: Tensor | None,
        symbols: Tensor,
        histories: Histories,
        *weights: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Evaluate the cell step by step; see the class."""
        hidden = weights[0].shape[-1]
        # tanh(x) = 2 sigmoid(2x) - 1: doubling the cell gate's inputs lets one vectorised sigmoid
        # serve all gates, at a third of tanh's time.
        scale = projections.new_ones(4, hidden)
        scale[2] = 2
        scale = scale.flatten()
        gates = (projections * scale).index_select(0, symbols)
        scaled = [(weight * scale.unsqueeze(1)).mT for weight in weights]
        h, c = gates.new_empty(len(symbols), hidden), gates.new_empty(len(symbols), hidden)
        # The first step reads them only where it continues.
        before_h, before_c = cast(Tensor, h_0), cast(Tensor, c_0)
        for block, parent, continues, sizes in histories.blocks():
            gate = gates[block]
            if parent is not None:
                past = _gather(before_h, parent, continues)
                gates_of, past_of = _parts(gate, sizes), _parts(past, sizes)
                for own, *factors in zip(gates_of, past_of, scaled, strict=True):
                    own.addmm_(*factors)
            i, f, g, o = gate.sigmoid_().split(hidden, 1)
            g.mul_(2).sub_(1)
            before_h, last_c, before_c = h[block], before_c, c[block]
            torch.mul(i, g, out=before_c)
            if parent is not None:
                before_c.addcmul_(f, _gather(last_c, parent, continues))
            torch.mul(_tanh(before_c), o, out=before_h)
        return h, c, gates

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        """Keep what the backward needs."""
        projections, h_0, c_0, symbols, histories, *weights = inputs
        h, c, gates = output
        ctx.mark_non_differentiable(gates)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(h_0, c_0, symbols, h, c, gates, *weights)
        ctx.histories, ctx.num_symbols = histories, len(projections)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_h: Tensor | None, grad_c: Tensor | None, _: None) -> tuple:
        """Go back through the steps, each node's gradient flowing into its parent's."""
        h_0, c_0, symbols, h, c, gates, *weights = ctx.saved_tensors
        hidden = h.shape[-1]
        grad_projections = h.new_zeros(ctx.num_symbols, 4 * hidden)
        grad_weights = [torch.zeros_like(weight) for weight in weights]
        blocks = ctx.histories.blocks()
        grad_h = torch.zeros_like(h) if grad_h is None else grad_h
        child_h = child_c = None  # what flows in from the next step
        for index in reversed(range(len(blocks))):
            block, parent, continues, sizes = blocks[index]
            i, f, g, o = gates[block].split(hidden, 1)
            tanh_c = _tanh(c[block])
            dh = grad_h[block] if child_h is None else child_h.add_(grad_h[block])
            dc = dh * o
            dc.addcmul_(dc * tanh_c, tanh_c, value=-1)
            if child_c is not None:
                dc.add_(child_c)
            if grad_c is not None:
                dc.add_(grad_c[block])
            grad = gates[block] * (1 - gates[block])
            di, df, dg, do = grad.split(hidden, 1)
            di.mul_(dc).mul_(g)
            torch.mul(g, g, out=dg).neg_().add_(1).mul_(dc).mul_(i)
            do.mul_(dh).mul_(tanh_c)
            child_h = child_c = None
            if parent is None:
                df.zero_()
            else:
                if index:
                    before_h, before_c = h[blocks[index - 1][0]], c[blocks[index - 1][0]]
                else:
                    before_h, before_c = h_0, c_0
                df.mul_(dc).mul_(_gather(before_c, parent, continues))
                past = _parts(_gather(before_h, parent, continues), sizes)
                grads = _parts(grad, sizes)
                for own, of_gates, of_past in zip(grad_weights, grads, past, strict=True):
                    own.addmm_(of_gates.t(), of_past)
                back = [own @ weight for own, weight in zip(grads, weights, strict=True)]
                grad_past = back[0] if len(back) == 1 else torch.cat(back)
                child_h = _scatter(grad_past, parent, continues, len(before_h))
                child_c = _scatter(dc.mul_(f), parent, continues, len(before_h))
            grad_projections.index_add_(0, symbols[block], grad)
        return grad_projections, child_h, child_c, None, None, *grad_weights


def _parts(x: Tensor, sizes: list[int] | None) -> tuple[Tensor, ...]:
    """The rows of each cell, or all of them."""
    return (x,) if sizes is None else x.split(sizes)


def _gather(states: Tensor, parent: Tensor, continues: Tensor | None) -> Tensor:
    states = states.index_select(0, parent)
    return states if continues is None else states.mul_(continues)


def _scatter(grad: Tensor, parent: Tensor, continues: Tensor | None, num_parents: int) -> Tensor:
    if continues is not None:
        grad.mul_(continues)
    return grad.new_zeros(num_parents, grad.shape[1]).index_add_(0, parent, grad)


def _tanh(x: Tensor) -> Tensor:
    return (x * 2).sigmoid_().mul_(2).sub_(1)
