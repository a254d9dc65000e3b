"""The one-layer softmax policy of Proposition 3, for problems without states."""

from __future__ import annotations

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution
from torchrl.modules import ProbabilisticActor

from torchrl_ecpo.checks import check_kind, described


class LinearSoftmax(nn.Module):
    r"""Logits :math:`\phi^\top \theta` of actions with feature vectors :math:`\phi`.

    Args:
        features: ``[num_actions, num_features]``, fixed. theta starts at zero: the uniform policy.

    Raises:
        TypeError: if features are no tensor.
        ValueError: if they are no matrix of finite numbers.

    Examples:
        >>> logits = LinearSoftmax(torch.eye(4))
        >>> logits(torch.ones(2, 3, 1)).shape  # one row for each observation, all equal
        torch.Size([2, 3, 4])
    """

    features: Tensor

    def __init__(self, features: Tensor) -> None:
        super().__init__()
        check_kind("features", features, Tensor)
        is_matrix = features.ndim == 2 and features.numel() and features.is_floating_point()
        if not is_matrix or not features.isfinite().all():
            raise ValueError(
                "features must be finite floating-point numbers [num_actions, num_features], got "
                f"{described(features)}."
            )
        self.register_buffer("features", features.clone())  # a state dict is loaded into it
        self.theta = nn.Parameter(features.new_zeros(features.shape[-1]))

    def forward(self, observation: Tensor) -> Tensor:
        """``[..., 1]`` to ``[..., num_actions]``; the observation says only how many are asked."""
        return (self.features @ self.theta).expand(*observation.shape[:-1], -1)

    def reset_parameters(self) -> None:
        """Back to the uniform policy."""
        nn.init.zeros_(self.theta)


class SharedCategorical(Distribution):
    """A categorical distribution that is the same in every row of the batch.

    All that depends on the number of actions is computed once, not once a row.

    Args:
        logits: ``[..., num_actions]``, all rows equal; only the first one is read.

    Raises:
        ValueError: if logits are no floating-point numbers, or actions no integers.

    Examples:
        >>> dist = SharedCategorical(logits=torch.zeros(4).expand(2, 3, 4))
        >>> dist.sample().shape, dist.log_prob(torch.zeros(2, 3, dtype=torch.int64)).exp()[0, 0]
        (torch.Size([2, 3]), tensor(0.2500))
    """

    arg_constraints: dict = {}  # noqa: RUF012 - torch declares it so

    def __init__(self, logits: Tensor) -> None:
        check_kind("logits", logits, Tensor)
        if not logits.is_floating_point() or not logits.numel() or not logits.ndim:
            raise ValueError(
                "logits must be floating-point numbers [..., num_actions], got "
                f"{described(logits)}."
            )
        batch_shape = logits.shape[:-1]
        super().__init__(batch_shape, validate_args=False)
        self.row = Categorical(logits=logits[(0,) * len(batch_shape)], validate_args=False)

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        """Draw int64 actions ``[*sample_shape, ...]``."""
        return self.row.sample(torch.Size((*sample_shape, *self.batch_shape)))

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-probability ``[...]`` of actions ``[...]``."""
        if not isinstance(value, Tensor) or value.dtype not in (torch.int64, torch.int32):
            raise ValueError(f"value must be actions, of torch.int64, got {described(value)}.")
        return self.row.log_prob(value)

    def entropy(self) -> Tensor:
        """Entropy in nats, ``[...]``."""
        return self.row.entropy().expand(self.batch_shape)

    @property
    def probs(self) -> Tensor:
        """Action probabilities ``[..., num_actions]``."""
        return self.row.probs.expand(*self.batch_shape, -1)

    @property
    def mode(self) -> Tensor:
        """The most probable action, ``[...]``."""
        return self.row.probs.argmax(-1).expand(self.batch_shape)

    deterministic_sample = mode  # which `ExplorationType.DETERMINISTIC` asks for


def make_softmax_policy(features: Tensor) -> ProbabilisticTensorDictSequential:
    """A policy with logits linear in the actions' features, for a problem without states.

    Args:
        features: ``[num_actions, num_features]``.

    Returns:
        An actor from ``observation`` to ``action`` and ``action_log_prob``.

    Examples:
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> env = BanditEnv(num_actions=4, group_size=3)
        >>> rollout = env.rollout(1, make_softmax_policy(env.features))
        >>> rollout["action_log_prob"].detach().exp().flatten()
        tensor([0.2500, 0.2500, 0.2500])
    """
    return ProbabilisticActor(
        TensorDictModule(LinearSoftmax(features), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=SharedCategorical,
        return_log_prob=True,
    )
