"""Policies whose action is the tuple (move, write, character)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torch.distributions import Distribution, constraints
from torch.distributions.utils import lazy_property
from torch.nn import functional as F
from torchrl.envs import ExplorationType, exploration_type
from torchrl.modules import ProbabilisticActor

from torchrl_ecpo.checks import check_count, check_counts, check_flag, check_kind, described
from torchrl_ecpo.modules.distinct import Evaluated, take_rows
from torchrl_ecpo.modules.recurrent import DistinctHistoryLSTM
from torchrl_ecpo.modules.windows import DistinctWindowNetwork, OneHotLinear


def _num_logits(nvec: Sequence[int]) -> int:
    try:
        is_nvec = len(nvec) == 3 and nvec[1] == 2 and min(nvec) >= 1
    except TypeError:
        is_nvec = False
    if not is_nvec:
        raise ValueError(
            "nvec: expected (moves, 2, characters), the sizes of move, write flag and "
            f"character, got {nvec!r}."
        )
    return sum(nvec)


class TupleCategorical(Distribution):
    """Distribution of the action tuple (move, write, character).

    log p(move) + log p(write) + [write = 1] log p(character): the character is 0 where nothing is
    written (write = 0), and has no log-probability there. The environment ignores it there, and an
    entropy term would reward its noise.

    `B` is any batch shape. Logits of any finite size give finite entropies and no NaN.

    Args:
        logits: `[*B, L]`, unnormalised; L = sum(nvec). With `rows`, `[n, L]`.
        nvec: the number of moves, of write flags (2) and of characters.
        rows: int64 `[*B]`, which of n rows of logits each element has: what depends on the logits
            alone is computed once for each. Default None: there is one for each element.
        validate_args: whether NaN logits and actions out of range are refused. Default True; False
            saves the checks, and on a GPU their synchronisation.

    Raises:
        ValueError: if nvec is not of the form (moves, 2, characters), L is another size, or a logit
            is NaN or infinity (-infinity: what is never taken), or if rows are not among those of
            the logits.

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

    arg_constraints: dict = {"logits": constraints.real_vector}  # noqa: RUF012 - as torch has it
    support: constraints.Constraint = constraints.independent(constraints.nonnegative_integer, 1)

    def __init__(
        self,
        logits: Tensor,
        nvec: Sequence[int],
        validate_args: bool = True,
        rows: Tensor | None = None,
    ) -> None:
        size = _num_logits(nvec)
        check_kind("logits", logits, Tensor)
        if logits.shape[-1:] != (size,) or not logits.is_floating_point():
            raise ValueError(
                f"logits: expected floating-point numbers, the last dimension {size} for "
                f"nvec={tuple(nvec)}, got {described(logits)}."
            )
        if check_flag("validate_args", validate_args) and not (logits < torch.inf).all():
            raise ValueError(
                "logits: expected numbers, got NaN or infinity; the network's weights may be NaN."
            )
        if rows is not None:
            check_kind("rows", rows, Tensor)
            if rows.dtype != torch.int64 or logits.ndim != 2:
                raise ValueError(
                    "rows: expected int64, and logits [n, L], got "
                    f"{described(rows)} and {described(logits)}."
                )
            if validate_args and ((rows < 0) | (rows >= len(logits))).any():
                raise ValueError(
                    f"rows: expected numbers in [0, {len(logits)}), one for each row of logits, "
                    f"got values from {rows.min()} to {rows.max()}."
                )
        self.nvec, self._table, self._rows = tuple(nvec), logits, rows
        batch_shape = logits.shape[:-1] if rows is None else rows.shape
        # The base class would check the same constraint, at several times the cost.
        super().__init__(batch_shape, torch.Size([3]), validate_args=False)
        self._validate_args = validate_args

    @lazy_property
    def logits(self) -> Tensor:
        """`[*B, L]`."""
        return self._of_rows(self._table)

    def at(self, rows: Tensor) -> TupleCategorical:
        """The distribution with other `rows` of the same logits; nothing is computed again."""
        other: Any = copy(self)
        other.__dict__.pop("logits", None)
        other._rows, other._batch_shape = rows, rows.shape
        other._joint, other._bounds = self._joint, self._bounds
        return other

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draw int64 actions `[*sample_shape, *B, 3]`, each part by inverting its distribution."""
        # Numbers of half precision are so coarse that 0 is among a few hundred.
        dtype = torch.promote_types(self._table.dtype, torch.float32)
        shape = (*sample_shape, *self.batch_shape, 3)
        return self.choose(torch.rand(shape, dtype=dtype, device=self._table.device))

    def choose(self, uniform: Tensor) -> Tensor:
        """Draw int64 actions with given numbers from [0, 1), both `[*sample_shape, *B, 3]`."""
        bounds = self._of_rows(self._bounds).to(uniform.dtype)
        bounds = bounds.expand(*uniform.shape, -1).contiguous()
        choice = torch.searchsorted(bounds, uniform.unsqueeze(-1), right=True).squeeze(-1)
        choice[..., 2].mul_(choice[..., 1])
        return choice

    def sample_and_log_prob(self, sample_shape: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        """Draw actions `[*sample_shape, *B, 3]`, with log-probabilities `[*sample_shape, *B]`."""
        action = self.sample(sample_shape)
        return action, self._score(action)

    @property
    def mode(self) -> Tensor:
        """The most probable action, int64 `[*B, 3]`."""
        choice = self._log_probs.argmax(-1)
        _, write, character = self._log_probs.unbind(-2)
        choice[..., 1] = write[..., 1] + character.amax(-1) > write[..., 0]
        choice[..., 2].mul_(choice[..., 1])
        return self._of_rows(choice)

    deterministic_sample = mode  # which `ExplorationType.DETERMINISTIC` asks for

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability `[...]` of int64 actions `[..., 3]`, broadcast against the batch shape.

        Raises:
            ValueError: if an action is out of range.
        """
        if self._validate_args:
            self._check_range(value)
        return self._score(value)

    def _score(self, value: Tensor) -> Tensor:
        """Log-probability of actions within range."""
        return self.log_prob_at(self.places(value))

    def places(self, value: Tensor) -> Tensor:
        """Where the log-probabilities of actions `[..., 3]` are, for :meth:`log_prob_at`.

        They are the same in any distribution with the same `rows`.
        """
        shape, rows = value.shape[:-1], self._rows
        if shape != self.batch_shape:
            try:
                torch.broadcast_shapes(shape, self.batch_shape)
            except RuntimeError:
                raise ValueError(
                    f"action: expected the batch shape {tuple(self.batch_shape)} of the logits, "
                    f"got {tuple(value.shape[:-1])}."
                ) from None
        if rows is None:
            rows = torch.arange(self.batch_shape.numel(), device=value.device)
            rows = rows.view(self.batch_shape)
        move, write, character = value.unbind(-1)
        moves, _, characters = self.nvec
        what = torch.addcmul(write, write, character)  # 0: nothing
        places = torch.add(what, move, alpha=1 + characters)
        return torch.add(places, rows, alpha=moves * (1 + characters))

    def log_prob_at(self, places: Tensor) -> Tensor:
        """Log-probability of the actions whose :meth:`places` these are, `[...]`."""
        return take_rows(self._joint.flatten(), places)

    def entropy(self) -> Tensor:
        """Exact entropy of the tuple, in nats, `[*B]`."""
        move, write, character = (-(self._log_probs.exp() * self._log_probs).sum(-1)).unbind(-1)
        return self._of_rows(move + write + character * self._log_probs[..., 1, 1].exp())

    def _of_rows(self, values: Tensor) -> Tensor:
        """Of each element `[*B, *]`, from those of the rows of logits."""
        return values if self._rows is None else take_rows(values, self._rows)

    @lazy_property
    def _log_probs(self) -> Tensor:
        """Normalised log-probabilities of each factor, of each row of logits: `[*, 3, n]`."""
        # The floor keeps 0 * log 0 at 0, for the padding and where a difference of logits
        # overflows.
        floor = torch.finfo(self._table.dtype).min
        width = max(self.nvec)
        parts = self._table.split(self.nvec, -1)
        padded = [F.pad(part, (0, width - part.shape[-1]), value=-torch.inf) for part in parts]
        factors = torch.stack(padded, -2)
        # On few classes log_softmax takes two to four times as long.
        return (factors - factors.logsumexp(-1, keepdim=True)).clamp(min=floor)

    @lazy_property
    def _joint(self) -> Tensor:
        """Log-probability of each move with each thing to write, nothing first: `[*, m, 1 + c]`."""
        parts = self._log_probs.unbind(-2)
        move, write, character = (part[..., :n] for part, n in zip(parts, self.nvec, strict=True))
        joint = move.unsqueeze(-1) + write.unsqueeze(-2)
        written = joint[..., 1:] + character.unsqueeze(-2)
        return torch.cat([joint[..., :1], written], -1)

    @lazy_property
    def _bounds(self) -> Tensor:
        """The distribution function of each factor, of each row of logits: `[*, 3, n]`."""
        log_probs = self._log_probs.detach()
        bounds = log_probs.to(torch.promote_types(log_probs.dtype, torch.float32)).exp().cumsum(-1)
        # The last bound is 1 whatever the rounding, and so are those of the padding.
        return bounds / bounds[..., -1:]

    def _check_range(self, action: Tensor) -> None:
        check_kind("action", action, Tensor)
        if action.shape[-1:] != (3,) or action.dtype not in (torch.int64, torch.int32):
            raise ValueError(
                "action: expected int64, the last dimension 3 (move, write, character), got "
                f"{described(action)}."
            )
        if ((action < 0) | (action >= action.new_tensor(self.nvec))).any():
            flat = action.reshape(-1, 3)
            raise ValueError(
                f"action: expected (move, write, character) in [0, nvec) for nvec={self.nvec}, "
                f"got values from {flat.amin(0).tolist()} to {flat.amax(0).tolist()}."
            )


class TupleTables(nn.Module):
    """A policy's network with tables beside its hidden layer: it may remember, where it helps.

    The hidden layer sees the present observation and the previous action, as a policy without
    memory. Two tables, 0 at first, add to its logits:

    - to those of the character: one row for each sequence of the last `window` observations and
      the last character written; none where one of these observations is a blank;
    - to those of the move: one row for the last two moves; none at a blank.

    A network over the whole window learns each of many cases through all others; a row of a table
    is of one case. Without a table at blanks, nothing is recited where the input has ended.

    Args:
        num_classes: the number of classes of the observation (the blank is the last) and of the
            previous action's parts, each with one more for none.
        window: how many steps are seen, at least 2.
        hidden_size: of the hidden layer (ReLU).

    Raises:
        TypeError: if `num_classes` is no sequence.
        ValueError: for a `window` below 2, and numbers of classes that are no positive integers.

    Examples:
        >>> import torch
        >>> from torchrl_ecpo.modules import TupleTables
        >>> network = TupleTables([4, 5, 3, 4], window=4, hidden_size=8)
        >>> network(torch.zeros(6, 4, 4, dtype=torch.int64)).shape  # 4 moves, 2 flags, 3 characters
        torch.Size([6, 9])
    """

    CHARACTER_STEP, MOVE_STEP = 2.0, 4.0
    """By how much a gradient step moves a table's row further than other parameters. Adam's steps
    do not depend on the gradient's size, so that a factor on the table is one on its steps."""

    def __init__(
        self,
        num_classes: Sequence[int],
        window: int,
        hidden_size: int = 64,
    ) -> None:
        super().__init__()
        self.window = check_count("window", window, least=2)
        observations, moves, _, characters = self.num_classes = check_counts(
            "num_classes", num_classes
        )
        self.num_moves, self.num_characters = moves - 1, characters - 1
        num_logits = self.num_moves + 2 + self.num_characters
        self.hidden = OneHotLinear(self.num_classes, hidden_size)
        self.readout = nn.Linear(hidden_size, num_logits)
        num_rows = (observations + 1) ** window * characters
        self.characters = nn.Parameter(torch.zeros(num_rows, self.num_characters))
        self.moves = nn.Parameter(torch.zeros((moves + 1) ** 2, self.num_moves))

    def forward(self, classes: Tensor) -> Tensor:
        """Logits `[n, L]` of int64 windows `[n, window, 4]`, the present step first, -1: none."""
        observation, move, write, character = classes.unbind(-1)
        blank, moves = self.num_classes[0] - 1, self.num_classes[1]
        logits = self.readout(self.hidden(classes[:, 0]).relu())
        by_move, _, by_character = logits.split([self.num_moves, 2, self.num_characters], -1)

        is_written = write == 1
        last = is_written.int().argmax(-1, keepdim=True)
        written = (character.gather(-1, last) + 1).where(is_written.any(-1, keepdim=True), 0)
        place = written.squeeze(-1)
        for seen in observation.unbind(-1):
            place = place * (blank + 2) + seen + 1
        is_inside = (observation != blank).all(-1, keepdim=True)
        of_character = self.CHARACTER_STEP * take_rows(self.characters, place) * is_inside

        place = (move[:, 0] + 1) * (moves + 1) + move[:, 1] + 1
        of_move = self.MOVE_STEP * take_rows(self.moves, place) * (observation[:, :1] != blank)
        added = [by_move + of_move, logits[:, self.num_moves :][:, :2], by_character + of_character]
        return torch.cat(added, -1)


def make_tuple_policy(
    num_observations: int,
    nvec: Sequence[int],
    *,
    hidden_size: int = 128,
    window: int | None = None,
    tables: bool = False,
) -> ProbabilisticActor:
    """Build the policy of the algorithmic tasks.

    One-hot observation and previous action, an LSTM (:class:`DistinctHistoryLSTM`) or a window of
    the last steps with a hidden layer (ReLU), a linear head, :class:`TupleCategorical`. It
    reads `observation` (int64 `[*B]`, below `num_observations`), `previous_action` (int64 `[*B,
    3]`, below nvec + 1: the last class of each means that there is none yet) and `is_init` (of
    `torchrl.envs.InitTracker`), and writes `logits`, `action` (int64 `[*B, 3]`) and
    `action_log_prob` (`[*B]`). It samples unless `set_exploration_type` asks for its mode.

    Args:
        num_observations: the number of observations, the blank included.
        nvec: the number of moves, of write flags (2) and of characters.
        hidden_size: of the LSTM, or of the hidden layer. Default 128 (the UREX paper's).
        window: how many steps a policy without LSTM sees, 1 for the present one alone
            (:class:`DistinctWindowNetwork`). Default None: the LSTM.
        tables: whether tables read what lies before the present step (:class:`TupleTables`).
            Default False: the hidden layer does.

    Returns:
        The actor. Its environment needs `InitTracker()` and, to sample, the state's primer. Both
        come from `torchrl.modules.get_env_transforms_from_module(actor)`, and
        `TrajectoryGroupCollector` does without either.

    Raises:
        ValueError: if `nvec` is not of the form (moves, 2, characters).

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
    num_observations = check_count("num_observations", num_observations)
    hidden_size = check_count("hidden_size", hidden_size)
    nvec = check_counts("nvec", nvec)
    num_classes = [num_observations, *(n + 1 for n in nvec)]
    inputs: list[NestedKey] = ["observation", "previous_action"]
    keys: dict[str, Any] = {"in_keys": inputs, "out_key": "logits"}
    core: Any
    if check_flag("tables", tables) and window is None:
        raise ValueError("tables=True needs a window, whose steps they are of; got window=None.")
    readout = nn.Linear(hidden_size, _num_logits(nvec))
    if window is None:
        core = DistinctHistoryLSTM(num_classes, hidden_size, readout, **keys)
    else:
        network: nn.Module
        if tables:
            network = TupleTables(num_classes, window, hidden_size)
        else:
            sizes = num_classes * check_count("window", window)
            network = nn.Sequential(OneHotLinear(sizes, hidden_size), nn.ReLU(), readout)
        core = DistinctWindowNetwork(num_classes, network, window, **keys)
    return _TupleActor(
        core,
        in_keys=["logits"],
        distribution_class=TupleCategorical,
        distribution_kwargs={"nvec": nvec},
        default_interaction_type=ExplorationType.RANDOM,
        return_log_prob=True,
        log_prob_key="action_log_prob",
    )


class TuplePolicy:
    """What policies over a ``DistinctCore`` share: distributions of each distinct past."""

    _known: TupleCategorical | None = None

    @property
    def parts(self) -> tuple[Any, dict[str, Any]]:
        """The core, and what the distribution takes beside the logits."""
        raise NotImplementedError

    @contextmanager
    def constant_weights(self) -> Iterator[None]:
        """Within, the weights do not change: what depends on them alone is computed once."""
        core, options = self.parts
        with core.constant_weights() as logits:
            if logits is not None:
                self._known = TupleCategorical(logits, **options)
            try:
                yield
            finally:
                self._known = None

    def read(self, tensordict: TensorDictBase) -> tuple[TupleCategorical, Evaluated]:
        """The distribution of the actions, and what the core makes of the batch."""
        core, options = self.parts
        read = core.read(tensordict)
        if self._known is not None:
            return self._known.at(read.nodes), read
        return TupleCategorical(read.output, rows=read.nodes, **options), read


class _TupleActor(TuplePolicy, ProbabilisticActor):
    """Evaluates distribution and sample once for each distinct past.

    Whatever else is asked of it goes the way of its base class, which costs as much as the LSTM
    over a few distinct histories.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.all_out_keys = list(self.out_keys)

    @property
    def parts(self) -> tuple[Any, dict[str, Any]]:
        modules: Any = self.module
        core, head = modules
        return core, head.distribution_kwargs

    def get_dist(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> Any:
        """The distribution of the actions; see the base class."""
        if args or kwargs:
            return super().get_dist(tensordict, *args, **kwargs)
        return self.read(tensordict)[0]

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Write what the core writes, action and log-probability; see the base class."""
        modules: Any = self.module
        core, head = modules
        kind = exploration_type() or head.default_interaction_type
        usual = len(args) == 1 and isinstance(args[0], TensorDictBase) and not kwargs
        selected = self.out_keys != self.all_out_keys
        if not usual or kind is not ExplorationType.RANDOM or selected:
            return super().forward(*args, **kwargs)
        distribution, read = self.read(args[0])
        action, log_prob = distribution.sample_and_log_prob()
        tensordict = core.write(args[0], read)
        return tensordict.set("action", action).set("action_log_prob", log_prob)
