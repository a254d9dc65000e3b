"""Policies: tuple actions, and a recurrent core that computes each distinct history once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import prod
from typing import Any, Literal, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.distributions import Distribution, constraints
from torch.distributions.utils import lazy_property
from torch.nn import functional as F
from torchrl.data import Composite, Unbounded
from torchrl.envs import ExplorationType, TensorDictPrimer
from torchrl.modules import LSTMModule, ProbabilisticActor, recurrent_mode

from torchrl_ecpo._histories import LSTMOverHistories, distinct_histories, hash_states

__all__ = ["DistinctHistoryLSTM", "TupleCategorical", "make_tuple_policy"]

Head = Literal["masked", "unmasked", "joint"]


class TupleCategorical(Distribution):
    """Distribution of the action tuple (move, write, character).

    Three heads. With the first and the last the character is 0 where nothing is written (write =
    0), and has no log-probability there.

    - `"masked"`: log p(move) + log p(write) + [write = 1] log p(character). The environment ignores
      the character where nothing is written; without the mask an entropy term would reward its
      noise.
    - `"unmasked"`: three independent factors.
    - `"joint"`: one softmax over move and (nothing, or a character to write), so over
      `nvec[0] * (1 + nvec[2])` classes, in that order; it can express any distribution of what the
      environment tells apart.

    `B` is any batch shape. Logits of any finite size give finite entropies and no NaN.

    Args:
        logits: `[*B, L]`, unnormalised; L = sum(nvec), or nvec[0] * (1 + nvec[2]) for the joint
            head.
        nvec: the number of moves, of write flags (2) and of characters.
        head: see above. Default `"masked"`: without the mask our runs on Reverse and
            ReversedAddition failed.
        validate_args: whether NaN logits and actions out of range are refused. Default True; False
            saves the checks, and on a GPU their synchronisation.

    Raises:
        ValueError: if the head is unknown, nvec is not of the form (moves, 2, characters), L is
            another size, or a logit is NaN.

    Examples:
        >>> import torch
        >>> from torchrl_ecpo.modules import TupleCategorical
        >>> dist = TupleCategorical(torch.zeros(4, 9), nvec=(2, 2, 5))
        >>> action = dist.sample()
        >>> action.shape, dist.log_prob(action).shape
        (torch.Size([4, 3]), torch.Size([4]))
        >>> dist.log_prob(torch.tensor([1, 0, 0])).exp()[0].item()
        0.25
    """

    has_rsample = False

    def __init__(
        self,
        logits: Tensor,
        nvec: Sequence[int],
        head: Head = "masked",
        validate_args: bool = True,
    ) -> None:
        size = self.num_logits(nvec, head)
        if logits.shape[-1:] != (size,):
            raise ValueError(
                f"logits: expected a last dimension of {size} for head={head!r} and "
                f"nvec={tuple(nvec)}, got shape {tuple(logits.shape)}."
            )
        self.nvec, self.head, self.logits = tuple(nvec), head, logits
        super().__init__(logits.shape[:-1], torch.Size([3]), validate_args=validate_args)

    @staticmethod
    def num_logits(nvec: Sequence[int], head: Head = "masked") -> int:
        """The number of logits that a head needs.

        Args:
            nvec: the number of moves, of write flags (2) and of characters.
            head: one of "masked", "unmasked" and "joint".

        Returns:
            The size of the last dimension of `logits`.

        Raises:
            ValueError: if the head is unknown or nvec is not of the form (moves, 2, characters).
        """
        if head not in ("masked", "unmasked", "joint"):
            raise ValueError(f"head: expected 'masked', 'unmasked' or 'joint', got {head!r}.")
        if len(nvec) != 3 or nvec[1] != 2 or min(nvec) < 1:
            raise ValueError(
                "nvec: expected (moves, 2, characters), the sizes of move, write flag and "
                f"character, got {tuple(nvec)}."
            )
        return nvec[0] * (1 + nvec[2]) if head == "joint" else sum(nvec)

    @property
    def arg_constraints(self) -> dict[str, constraints.Constraint]:
        """Logits without NaN."""
        return {"logits": constraints.real_vector}

    @property
    def support(self) -> constraints.Constraint:
        """Tuples of integers of at least 0; their upper bounds are nvec."""
        return constraints.independent(constraints.nonnegative_integer, 1)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draw actions by the Gumbel-max trick, in one pass over the logits.

        Args:
            sample_shape: the shape of the sample, before the batch shape.

        Returns:
            int64 `[*sample_shape, *B, 3]`.
        """
        logits = self.logits.detach()
        uniform = torch.rand(
            (*sample_shape, *logits.shape), dtype=logits.dtype, device=logits.device
        )
        gumbel = uniform.log_().neg_().log_().neg_()
        return self._decode(self._factors(logits + gumbel).argmax(-1))

    @property
    def mode(self) -> Tensor:
        """The most probable action, int64 `[*B, 3]`; exact for each head."""
        choice = self._log_probs.argmax(-1)
        if self.head == "masked":
            _, write, character = self._log_probs.unbind(-2)
            choice[..., 1] = write[..., 1] + character.amax(-1) > write[..., 0]
        return self._decode(choice)

    @property
    def deterministic_sample(self) -> Tensor:
        """The most probable action: what `ExplorationType.DETERMINISTIC` asks for."""
        return self.mode

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability of actions.

        Args:
            value: int64 `[..., 3]`, broadcast against the batch shape. Where nothing is written
                the character is read only by the unmasked head.

        Returns:
            `[...]`.

        Raises:
            ValueError: if an action is out of range.
        """
        if self._validate_args:
            self._check_range(value)
        index = self._encode(value)
        shape = index.shape[:-1]
        if shape != self.batch_shape:
            shape = torch.broadcast_shapes(shape, self.batch_shape)
        log_probs = self._log_probs.expand(*shape, *self._log_probs.shape[-2:])
        index = index.expand(*shape, -1).unsqueeze(-1)
        return self._sum(log_probs.gather(-1, index).squeeze(-1), value[..., 1] == 1)

    def entropy(self) -> Tensor:
        """Exact entropy of the tuple, in nats, `[*B]`."""
        entropies = -(self._log_probs.exp() * self._log_probs).sum(-1)
        if self.head != "masked":
            return entropies.sum(-1)
        move, write, character = entropies.unbind(-1)
        return move + write + character * self._log_probs[..., 1, 1].exp()

    @lazy_property
    def _log_probs(self) -> Tensor:
        """Normalised log-probabilities of each factor, `[*B, F, n]`."""
        # The floor keeps 0 * log 0 at 0, for the padding and where a difference of logits
        # overflows.
        floor = torch.finfo(self.logits.dtype).min
        # On few classes log_softmax takes two to four times as long.
        factors = self._factors(self.logits)
        return (factors - factors.logsumexp(-1, keepdim=True)).clamp(min=floor)

    def _factors(self, values: Tensor) -> Tensor:
        """Values of each logit `[..., L]`, by factor, padded with -inf: `[..., F, n]`."""
        if self.head == "joint":
            return values.unsqueeze(-2)
        width = max(self.nvec)
        padding = values.new_full((), -torch.inf)
        pieces = []
        for part in values.split(self.nvec, -1):
            pieces += [part, padding.expand(*part.shape[:-1], width - part.shape[-1])]
        return torch.cat(pieces, -1).unflatten(-1, (3, width))

    def _sum(self, log_probs: Tensor, writes: Tensor) -> Tensor:
        """The tuple's log-probability from its factors' `[..., F]`."""
        if self.head != "masked":
            return log_probs.sum(-1)
        move, write, character = log_probs.unbind(-1)
        return move + write + torch.where(writes, character, 0)

    def _decode(self, choice: Tensor) -> Tensor:
        """The action `[..., 3]` that has the class `choice` `[..., F]` of each factor."""
        if self.head == "joint":
            written = choice.squeeze(-1) % (1 + self.nvec[2])
            move = choice.squeeze(-1) // (1 + self.nvec[2])
            return torch.stack([move, (written > 0).long(), (written - 1).clamp(min=0)], -1)
        if self.head == "masked":
            choice[..., 2] *= choice[..., 1]
        return choice

    def _encode(self, action: Tensor) -> Tensor:
        """The class of each factor, `[..., F]`, that an action `[..., 3]` has."""
        if self.head != "joint":
            return action
        move, write, character = action.unbind(-1)
        return (move * (1 + self.nvec[2]) + write * (1 + character)).unsqueeze(-1)

    def _check_range(self, action: Tensor) -> None:
        if action.shape[-1:] != (3,):
            raise ValueError(
                f"action: expected a last dimension of 3 (move, write, character), got shape "
                f"{tuple(action.shape)}."
            )
        if ((action < 0) | (action >= action.new_tensor(self.nvec))).any():
            flat = action.reshape(-1, 3)
            raise ValueError(
                f"action: expected (move, write, character) in [0, nvec) for nvec={self.nvec}, "
                f"got values from {flat.amin(0).tolist()} to {flat.amax(0).tolist()}."
            )


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
    - Recurrent mode: padded steps, by `("collector", "mask")` where it is there, cost nothing and
      give zeros. Gradients are exact (once: no second derivatives); where equal states are given
      to begin with, one of them gets the gradient of all. No states are written: the update needs
      none.

    Args:
        num_classes: the number of classes of each input, in the order of the input keys and of
            their last dimensions.
        hidden_size: H. Default 128 (the UREX paper's).
        readout: a module that is applied to each distinct output `[n, H]`, for example a linear
            layer to logits. Default None: the output is the LSTM's.
        in_keys: the integer inputs, each `[*B]` or `[*B, d]`.
        out_key: the output. Default "embed".
        state_key: the states' keys are this with "_h" and "_c" appended, each `[*B, 1, H]`. Default
            "recurrent_state", as with `LSTMModule`.
        store_states: whether the states stay in collected data, where they are needed only for
            sequences that begin in the middle of a trajectory. Default False: they would take most
            of a rollout's memory.
        device: of the parameters.
        dtype: of the parameters.

    Attributes:
        cell: the `torch.nn.LSTMCell` that holds the parameters, initialised by PyTorch: uniform in
            +-1/sqrt(H).

    Raises:
        KeyError: if `is_init` is missing, or the state of a row that continues.
        ValueError: if an input is out of range, or there is no time dimension in recurrent mode.

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
        state_key: str = "recurrent_state",
        store_states: bool = False,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        self.num_classes = tuple(num_classes)
        self.num_symbols = prod(num_classes)
        if min(num_classes) < 1 or self.num_symbols > 2**31:
            raise ValueError(
                "num_classes: expected positive numbers with a product of at most 2^31, got "
                f"{self.num_classes}."
            )
        states = (f"{state_key}_h", f"{state_key}_c")
        self.input_keys = list(in_keys)
        all_keys: list[Any] = [*in_keys, *states, "is_init"]
        self.in_keys = all_keys
        out_keys: list[Any] = [out_key, *(("next", key) for key in states)]
        self.out_keys = out_keys
        self.state_keys, self.store_states = states, store_states
        self.cell = nn.LSTMCell(sum(num_classes), hidden_size, device=device, dtype=dtype)
        self.readout = readout if readout is not None else nn.Identity()

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that lets an environment carry the states from step to step.

        Returns:
            A :class:`torchrl.envs.TensorDictPrimer`; collectors append it by themselves.
        """
        primer = TensorDictPrimer if self.store_states else _TransientPrimer
        spec = Unbounded(torch.Size((1, self.cell.hidden_size)), dtype=self.cell.weight_hh.dtype)
        return primer(dict.fromkeys(self.state_keys, spec), expand_specs=True)

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
        symbols, starts = self._symbols(tensordict), is_init.reshape(shape)
        if recurrent_mode():
            if not shape:
                raise ValueError(
                    "tensordict: expected a batch shape [*B, T], time last, in recurrent mode, got "
                    "none."
                )
            mask = tensordict.get(("collector", "mask"), None)
            starts = starts if mask is None else starts | ~mask
            symbols, starts, mask = (_time_first(x) for x in (symbols, starts, mask))
            nodes, output, *_ = self._run(symbols, starts, mask, self._states(tensordict, starts))
            return tensordict.set(self.out_keys[0], _rows(output, nodes.t(), shape))

        ended = tensordict.get("done", None)
        if ended is not None:
            ended = ended.reshape(shape)
            starts, symbols = starts | ended, symbols.masked_fill(ended, 0)
        symbols, starts = symbols.reshape(1, -1), starts.reshape(1, -1)
        nodes, output, h, c = self._run(symbols, starts, None, self._states(tensordict, starts))
        tensordict.set(self.out_keys[0], _rows(output, nodes, shape))
        for key, state in zip(self.out_keys[1:], (h, c), strict=True):
            tensordict.set(key, _rows(state, nodes, (*shape, 1)))
        return tensordict

    def _run(
        self,
        symbols: Tensor,
        starts: Tensor,
        mask: Tensor | None,
        states: tuple[Tensor, Tensor] | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Of sequences `[T, N]`, the node at each place; each node's output, h and c `[n, *]`."""
        histories = distinct_histories(
            symbols,
            starts,
            mask,
            num_symbols=self.num_symbols,
            first_hashes=None if states is None else hash_states(*states),
        )
        present, node_symbols = symbols.flatten()[histories.rows].unique(return_inverse=True)
        lstm = LSTMOverHistories
        h, c, _ = (lstm.apply if torch.is_grad_enabled() else lstm.forward)(
            self._project(present),
            self.cell.weight_hh,
            *((None, None) if states is None else states),
            node_symbols,
            histories,
        )
        output = self.readout(h)
        nodes = histories.nodes
        if mask is not None:
            # Node -1, the padding, is the last row.
            output = torch.cat([output, output.new_zeros(1, output.shape[-1])])
            nodes = nodes.masked_fill(nodes < 0, len(output) - 1)
        return nodes, output, h, c

    def _symbols(self, tensordict: TensorDictBase) -> Tensor:
        """The input tuple as one number, int64 `[*B]`."""
        inputs = [tensordict.get(key) for key in self.input_keys]
        ndim = tensordict.ndim
        classes = torch.cat([x if x.ndim > ndim else x.unsqueeze(-1) for x in inputs], -1)
        if classes.shape[-1] != len(self.num_classes):
            raise ValueError(
                f"{self.input_keys}: expected {len(self.num_classes)} integers in all, one for "
                f"each of num_classes, got {classes.shape[-1]}."
            )
        sizes, weights, _ = _radix(self.num_classes, classes.device)
        if ((classes < 0) | (classes >= sizes)).any():
            flat = classes.reshape(-1, len(self.num_classes))
            raise ValueError(
                f"{self.input_keys}: expected classes in [0, n) for n in {self.num_classes}, got "
                f"values from {flat.amin(0).tolist()} to {flat.amax(0).tolist()}."
            )
        return (classes * weights).sum(-1)

    def _project(self, symbols: Tensor) -> Tensor:
        """The input's part of the gates, `[S, 4H]`: a one-hot product is a sum of columns."""
        sizes, weights, offsets = _radix(self.num_classes, symbols.device)
        hot = symbols.unsqueeze(-1) // weights % sizes + offsets
        columns = F.embedding_bag(hot, self.cell.weight_ih.t().contiguous(), mode="sum")
        return columns + (self.cell.bias_ih + self.cell.bias_hh)

    def _states(self, tensordict: TensorDictBase, starts: Tensor) -> tuple[Tensor, Tensor] | None:
        """The states `[N, H]` that rows continue from; None where all start."""
        if starts[0].all():
            return None
        if recurrent_mode() and not self.store_states:
            raise ValueError(
                "is_init: expected every sequence to begin with a trajectory's first step, since "
                "states are not stored, and some do not; keep trajectories whole, or make the "
                "policy with store_states=True."
            )
        h, c = (tensordict.get(key, None) for key in self.state_keys)
        if h is None or c is None:
            raise KeyError(
                f"{self.state_keys}: expected the states of rows that continue a trajectory, found "
                "none; append this module's make_tensordict_primer() to the environment."
            )
        # [*B, 1, H]; of a sequence, the first.
        if recurrent_mode():
            h, c = h[..., 0, :, :], c[..., 0, :, :]
        return h.reshape(-1, h.shape[-1]), c.reshape(-1, c.shape[-1])


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


class _OneHot(nn.Module):
    """One-hot vectors of the inputs, concatenated.

    Args:
        num_classes: the number of classes of the observation and of each part of the action.
        dtype: of the vectors. Default None: PyTorch's default.
    """

    def __init__(self, num_classes: Sequence[int], dtype: torch.dtype | None = None) -> None:
        super().__init__()
        self.num_classes = tuple(num_classes)
        self.dtype = dtype or torch.get_default_dtype()

    def forward(self, observation: Tensor, previous_action: Tensor) -> Tensor:
        """Encode observations `[*B]` and actions `[*B, d]`: `[*B, sum(num_classes)]`."""
        columns = [observation, *previous_action.unbind(-1)]
        hots = [F.one_hot(x, n) for x, n in zip(columns, self.num_classes, strict=True)]
        return torch.cat(hots, -1).to(self.dtype)


def make_tuple_policy(
    num_observations: int,
    nvec: Sequence[int],
    *,
    hidden_size: int = 128,
    head: Head = "masked",
    distinct_histories: bool = True,
    store_states: bool = False,
    device: torch.device | str | None = None,
    dtype: torch.dtype | None = None,
) -> ProbabilisticActor:
    """Build the recurrent policy of the algorithmic tasks.

    One-hot observation and previous action, an LSTM, a linear head, :class:`TupleCategorical`. It
    reads `observation` (int64 `[*B]`, below `num_observations`), `previous_action` (int64 `[*B,
    3]`, below nvec + 1: the last class of each means that there is none yet) and `is_init` (of
    `torchrl.envs.InitTracker`), and writes `logits`, `action` (int64 `[*B, 3]`) and
    `action_log_prob` (`[*B]`). It samples unless `set_exploration_type` asks for its mode.

    Args:
        num_observations: the number of observations, the blank included.
        nvec: the number of moves, of write flags (2) and of characters.
        hidden_size: of the LSTM. Default 128 (the UREX paper's).
        head: "masked", "unmasked" or "joint": see :class:`TupleCategorical`.
        distinct_histories: whether rows with equal histories are computed once
            (:class:`DistinctHistoryLSTM`), or each row by :class:`torchrl.modules.LSTMModule`. The
            numbers and the order of the parameters are the same.
        store_states: see :class:`DistinctHistoryLSTM`; `LSTMModule` always stores them.
        device: of the parameters.
        dtype: of the parameters.

    Returns:
        The actor. Its environment needs `InitTracker()` and, to sample, the state's primer:
        `torchrl.modules.get_env_transforms_from_module(actor)` gives both.

    Raises:
        ValueError: if `head` or `nvec` are not as above.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import set_recurrent_mode
        >>> from torchrl_ecpo.modules import make_tuple_policy
        >>> actor = make_tuple_policy(num_observations=6, nvec=(2, 2, 5), hidden_size=8)
        >>> data = TensorDict(
        ...     observation=torch.randint(6, (4, 10)),
        ...     previous_action=torch.zeros(4, 10, 3, dtype=torch.int64),
        ...     is_init=(torch.arange(10) == 0).expand(4, 10).unsqueeze(-1),
        ...     batch_size=[4, 10],
        ... )
        >>> step = actor(data[:, 0])
        >>> step["action"].shape, step["action_log_prob"].shape
        (torch.Size([4, 3]), torch.Size([4]))
        >>> with set_recurrent_mode(True):
        ...     actor.get_dist(data).entropy().shape
        torch.Size([4, 10])
    """
    num_logits = TupleCategorical.num_logits(nvec, head)
    num_classes = [num_observations, *(n + 1 for n in nvec)]
    inputs: list[NestedKey] = ["observation", "previous_action"]
    factory: dict[str, Any] = {"device": device, "dtype": dtype}
    core: Any
    readout = nn.Linear(hidden_size, num_logits, **factory)
    if distinct_histories:
        core = DistinctHistoryLSTM(
            num_classes,
            hidden_size,
            readout=readout,
            in_keys=inputs,
            out_key="logits",
            store_states=store_states,
            **factory,
        )
    else:
        lstm = nn.LSTM(sum(num_classes), hidden_size, batch_first=True, **factory)
        modules: list[Any] = [
            TensorDictModule(_OneHot(num_classes, dtype), in_keys=inputs, out_keys=["one_hot"]),
            LSTMModule(lstm=lstm, in_key="one_hot", out_key="embed"),
            TensorDictModule(readout, in_keys=["embed"], out_keys=["logits"]),
        ]
        core = TensorDictSequential(*modules)
    return ProbabilisticActor(
        core,
        in_keys=["logits"],
        distribution_class=TupleCategorical,
        distribution_kwargs={"nvec": tuple(nvec), "head": head},
        default_interaction_type=ExplorationType.RANDOM,
        return_log_prob=True,
        log_prob_key="action_log_prob",
    )


@lru_cache(maxsize=64)
def _radix(num_classes: tuple[int, ...], device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Bases and weights of input tuples as numbers; where each digit's one-hot vector starts."""
    sizes = torch.tensor(num_classes, device=device)
    weights = sizes.flip(0).cumprod(0).flip(0) // sizes
    return sizes, weights, sizes.cumsum(0) - sizes


def _time_first(x: Tensor | None) -> Any:
    """`[*B, T]` to `[T, N]`."""
    return None if x is None else x.reshape(-1, x.shape[-1]).t().contiguous()


def _rows(values: Tensor, index: Tensor, shape: Sequence[int]) -> Tensor:
    """`values[index]` along the first dimension, `[*shape, *]`."""
    # Quicker than indexing, above all backwards.
    return values.index_select(0, index.reshape(-1)).reshape(*shape, -1)
