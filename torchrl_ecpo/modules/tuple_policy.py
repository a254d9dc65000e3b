"""Policies whose action is the tuple (move, write, character)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.distributions import Distribution, constraints
from torch.distributions.utils import lazy_property
from torch.nn import functional as F
from torchrl.envs import ExplorationType, exploration_type
from torchrl.modules import LSTMModule, ProbabilisticActor

from torchrl_ecpo.checks import check_count, check_counts, check_flag, check_kind, described
from torchrl_ecpo.modules.recurrent import DistinctHistoryLSTM

__all__ = ["TupleCategorical", "make_tuple_policy"]


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
        logits: `[*B, L]`, unnormalised; L = sum(nvec).
        nvec: the number of moves, of write flags (2) and of characters.
        validate_args: whether NaN logits and actions out of range are refused. Default True; False
            saves the checks, and on a GPU their synchronisation.

    Raises:
        ValueError: if nvec is not of the form (moves, 2, characters), L is another size, or a logit
            is NaN or infinity (-infinity: what is never taken).

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

    def __init__(self, logits: Tensor, nvec: Sequence[int], validate_args: bool = True) -> None:
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
        self.nvec, self.logits = tuple(nvec), logits
        # The base class would check the same constraint, at several times the cost.
        super().__init__(logits.shape[:-1], torch.Size([3]), validate_args=False)
        self._validate_args = validate_args

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draw actions by the Gumbel-max trick, in one pass over the logits.

        Args:
            sample_shape: the shape of the sample, before the batch shape.

        Returns:
            int64 `[*sample_shape, *B, 3]`.
        """
        logits = self.logits
        # Numbers of half precision are so coarse that 0 is among a few hundred.
        dtype = torch.promote_types(logits.dtype, torch.float32)
        shape = (*sample_shape, *logits.shape)
        return self.choose(torch.rand(shape, dtype=dtype, device=logits.device))

    def choose(self, uniform: Tensor) -> Tensor:
        """Draw actions with given randomness.

        Args:
            uniform: drawn uniformly from [0, 1), `[*sample_shape, *B, L]`; overwritten.

        Returns:
            int64 `[*sample_shape, *B, 3]`.
        """
        gumbel = uniform.log_().neg_().log_()  # its negative
        choice = self._factors(self.logits.detach() - gumbel).argmax(-1)
        choice[..., 2].mul_(choice[..., 1])
        return choice

    def sample_and_log_prob(self, sample_shape: Sequence[int] = ()) -> tuple[Tensor, Tensor]:
        """Draw actions and give their log-probabilities; there is no need to check their range.

        Args:
            sample_shape: the shape of the sample, before the batch shape.

        Returns:
            int64 `[*sample_shape, *B, 3]` and `[*sample_shape, *B]`.
        """
        action = self.sample(sample_shape)
        return action, self._score(action)

    @property
    def mode(self) -> Tensor:
        """The most probable action, int64 `[*B, 3]`."""
        choice = self._log_probs.argmax(-1)
        _, write, character = self._log_probs.unbind(-2)
        choice[..., 1] = write[..., 1] + character.amax(-1) > write[..., 0]
        choice[..., 2].mul_(choice[..., 1])
        return choice

    deterministic_sample = mode  # which `ExplorationType.DETERMINISTIC` asks for

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability of actions.

        Args:
            value: int64 `[..., 3]`, broadcast against the batch shape.

        Returns:
            `[...]`.

        Raises:
            ValueError: if an action is out of range.
        """
        if self._validate_args:
            self._check_range(value)
        return self._score(value)

    def _score(self, value: Tensor) -> Tensor:
        """Log-probability of actions within range."""
        index, log_probs = value, self._log_probs
        if index.shape[:-1] != self.batch_shape:
            try:
                shape = torch.broadcast_shapes(index.shape[:-1], self.batch_shape)
            except RuntimeError:
                raise ValueError(
                    f"action: expected the batch shape {tuple(self.batch_shape)} of the logits, "
                    f"got {tuple(index.shape[:-1])}."
                ) from None
            log_probs = log_probs.expand(*shape, *log_probs.shape[-2:])
            index = index.expand(*shape, -1)
        move, write, character = log_probs.gather(-1, index.unsqueeze(-1)).squeeze(-1).unbind(-1)
        return move + write + torch.where(value[..., 1] == 1, character, 0)

    def entropy(self) -> Tensor:
        """Exact entropy of the tuple, in nats, `[*B]`."""
        move, write, character = (-(self._log_probs.exp() * self._log_probs).sum(-1)).unbind(-1)
        return move + write + character * self._log_probs[..., 1, 1].exp()

    @lazy_property
    def _log_probs(self) -> Tensor:
        """Normalised log-probabilities of each factor, `[*B, 3, n]`."""
        # The floor keeps 0 * log 0 at 0, for the padding and where a difference of logits
        # overflows.
        floor = torch.finfo(self.logits.dtype).min
        # On few classes log_softmax takes two to four times as long.
        factors = self._factors(self.logits)
        return (factors - factors.logsumexp(-1, keepdim=True)).clamp(min=floor)

    def _factors(self, values: Tensor) -> Tensor:
        """Values of each logit `[..., L]`, by factor, padded with -inf: `[..., 3, n]`."""
        width = max(self.nvec)
        if min(self.nvec) < width:
            parts = values.split(self.nvec, -1)
            values = torch.cat(
                [F.pad(part, (0, width - part.shape[-1]), value=-torch.inf) for part in parts], -1
            )
        return values.unflatten(-1, (3, width))

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


def make_tuple_policy(
    num_observations: int,
    nvec: Sequence[int],
    *,
    hidden_size: int = 128,
    distinct_histories: bool = True,
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
        distinct_histories: whether rows with equal histories are computed once
            (:class:`DistinctHistoryLSTM`), or each row by :class:`torchrl.modules.LSTMModule`. The
            numbers and the order of the parameters are the same.
        device: of the parameters.
        dtype: of the parameters.

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
    factory: dict[str, Any] = {"device": device, "dtype": dtype}
    core: Any
    readout = nn.Linear(hidden_size, _num_logits(nvec), **factory)
    if check_flag("distinct_histories", distinct_histories):
        core = DistinctHistoryLSTM(
            num_classes,
            hidden_size,
            readout=readout,
            in_keys=inputs,
            out_key="logits",
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
    return _TupleActor(
        core,
        in_keys=["logits"],
        distribution_class=TupleCategorical,
        distribution_kwargs={"nvec": nvec},
        default_interaction_type=ExplorationType.RANDOM,
        return_log_prob=True,
        log_prob_key="action_log_prob",
    )


class _TupleActor(ProbabilisticActor):
    """Samples in one pass; whatever else is asked of it goes the way of its base class.

    That way costs as much as the LSTM over a few distinct histories.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.all_out_keys = list(self.out_keys)

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Write what the core writes, action and log-probability; see the base class."""
        modules: Any = self.module
        core, head = modules
        kind = exploration_type() or head.default_interaction_type
        usual = len(args) == 1 and isinstance(args[0], TensorDictBase) and not kwargs
        selected = self.out_keys != self.all_out_keys
        if not usual or kind is not ExplorationType.RANDOM or selected:
            return super().forward(*args, **kwargs)
        tensordict = core(args[0])
        distribution = TupleCategorical(tensordict.get("logits"), **head.distribution_kwargs)
        action, log_prob = distribution.sample_and_log_prob()
        return tensordict.set("action", action).set("action_log_prob", log_prob)


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
