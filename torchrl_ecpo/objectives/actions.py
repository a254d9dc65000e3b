"""Actions at each state among which a lift chooses: M samples of a policy, or all there are.

Everywhere the axis of actions comes first: ``[M, *B]``, with ``*B`` the batch of states.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    Normal,
    OneHotCategorical,
    TransformedDistribution,
)

__all__ = ["SampledActions", "gaussian_parameters", "is_discrete", "log_prob_of", "sample_actions"]


class SampledActions(NamedTuple):
    """M actions of a continuous policy at each state."""

    action: Tensor
    """``[M, *B, A]``."""
    log_prob: Tensor
    """``[M, *B]``, under the policy that drew them; in a space whose volume is the actions'."""
    latent: Tensor
    """``[M, *B, A]``, the action before the policy's transform (tanh), or the action itself."""
    log_volume: Tensor | float
    """``[M, *B]``, log-determinant of the transform at the latent, the same for every policy."""


def is_discrete(distribution: type | Distribution) -> bool:
    """Whether a policy chooses one of n actions, by index or one-hot."""
    kind = distribution if isinstance(distribution, type) else type(distribution)
    return issubclass(kind, (Categorical, OneHotCategorical))


def sample_actions(distribution: Distribution, num_samples: int) -> SampledActions:
    """Draw M actions at each state, differentiable with respect to the policy where it is.

    Log-probabilities are those of the latent that was drawn: a saturated tanh is never inverted.

    Args:
        distribution: of batch shape ``[*B]`` and event shape ``[A]``.
        num_samples: M.
    """
    base, transforms = _split(distribution)
    latent = base.rsample(torch.Size([num_samples]))
    action, log_volume = latent, 0.0
    for transform in transforms:
        before, action = action, transform(action)
        log_det = transform.log_abs_det_jacobian(before, action)
        log_volume = log_volume + (log_det if transform.domain.event_dim else log_det.sum(-1))
    return SampledActions(action, base.log_prob(latent) - log_volume, latent, log_volume)


def log_prob_of(actions: SampledActions, distribution: Distribution) -> Tensor:
    """Log-probability ``[M, *B]`` under another policy of the same transform."""
    return _split(distribution)[0].log_prob(actions.latent) - actions.log_volume


def gaussian_parameters(distribution: Distribution) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation ``[*B, A]`` of the (latent) diagonal Gaussian of a policy.

    Raises:
        ValueError: if it is not a diagonal Gaussian, transformed or not.
    """
    base, _ = _split(distribution)
    normal = base.base_dist if isinstance(base, Independent) else base
    if not isinstance(normal, Normal):
        raise ValueError(
            'projection="centred" needs a diagonal Gaussian policy, transformed (TanhNormal) or '
            f'not, got {type(distribution).__name__}. Use projection="paper", which takes any.'
        )
    return normal.loc, normal.scale


def _split(distribution: Distribution) -> tuple[Distribution, list]:
    if isinstance(distribution, TransformedDistribution):
        return distribution.base_dist, distribution.transforms
    return distribution, []
