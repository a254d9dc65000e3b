"""Actions that stand for a policy at each state: M samples of it, or all there are.

Expectations, divergences and soft values over actions are sums over either. The axis of actions
comes first everywhere: ``[M, *B]``, with ``*B`` the batch of states.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    Normal,
    OneHotCategorical,
)

from torchrl_ecpo.functional import (
    lift_divergence_estimate,
    lifted_log_weights,
    log_mean_exp,
    soft_value,
    widened,
)
from torchrl_ecpo.modules.latents import split

__all__ = [
    "Actions",
    "AllActions",
    "PairedActions",
    "SampledActions",
    "actions_of",
    "gaussian_parameters",
    "is_discrete",
]


def is_discrete(distribution: type | Distribution) -> bool:
    """Whether a policy chooses one of n actions, by index or one-hot."""
    kind = distribution if isinstance(distribution, type) else type(distribution)
    return issubclass(kind, (Categorical, OneHotCategorical))


def actions_of(distribution: Distribution, num_samples: int) -> Actions:
    """The actions that stand for a policy: all of one over n actions, samples of any other.

    Args:
        distribution: of batch shape ``[*B]``.
        num_samples: M; without meaning where all actions are taken.

    Raises:
        ValueError: for a policy with neither.
    """
    check_policy(distribution)
    if is_discrete(distribution):
        return AllActions.of(distribution)
    return SampledActions.of(distribution, num_samples)


def check_policy(distribution: type | Distribution) -> None:
    """Refuse distributions, or classes of them, that no actor-critic loss takes."""
    kind = distribution if isinstance(distribution, type) else type(distribution)
    # A class does not know whether what it wraps has rsample: a property is true.
    if not is_discrete(kind) and not distribution.has_rsample:  # pyright: ignore
        raise ValueError(
            "The policy of an actor-critic loss must be over one of n actions (Categorical, "
            "OneHotCategorical) or over one vector with rsample (TanhNormal), got "
            f"{kind.__name__}. Several discrete actions and hybrid ones are for the losses of "
            "groups, such as ECPOLoss."
        )


class SampledActions(NamedTuple):
    """M actions of a continuous policy at each state, which stand for it by their number.

    Examples:
        >>> policy = Independent(Normal(torch.zeros(3, 2), torch.ones(3, 2)), 1)  # 3 states, A = 2
        >>> actions = SampledActions.of(policy, 8)
        >>> actions.action.shape, actions.log_prob.shape
        (torch.Size([8, 3, 2]), torch.Size([8, 3]))
    """

    log_prob: Tensor
    """``[M, *B]``, under the policy that drew them; in a space whose volume is the actions'."""
    action: Tensor
    """``[M, *B, A]``."""
    latent: Tensor
    """``[M, *B, A]``, the action before the policy's transform (tanh), or the action itself."""
    log_volume: Tensor | float
    """``[M, *B]``, log-determinant of the transform at the latent, the same for every policy."""

    @classmethod
    def of(cls, distribution: Distribution, num_samples: int) -> SampledActions:
        """Draw M actions at each state, differentiable with respect to the policy where it is.

        Log-probabilities are those of the latent that was drawn: a saturated tanh is never
        inverted.
        """
        base, _ = split(distribution)
        return cls.at(base.rsample(torch.Size([num_samples])), distribution)

    @classmethod
    def at(cls, latent: Tensor, distribution: Distribution) -> SampledActions:
        """Those that come of latents ``[M, *B, A]``."""
        base, transforms = split(distribution)
        action, log_volume = latent, 0.0
        for transform in transforms:
            before, action = action, transform(action)
            log_det = transform.log_abs_det_jacobian(before, action)
            log_volume = log_volume + (log_det if transform.domain.event_dim else log_det.sum(-1))
        return cls(base.log_prob(latent) - log_volume, action, latent, log_volume)

    def log_prob_of(self, distribution: Distribution) -> Tensor:
        """Log-probability ``[M, *B]`` under another policy of the same transform."""
        return split(distribution)[0].log_prob(self.latent) - self.log_volume

    def mean(self, values: Tensor) -> Tensor:
        """Expectation ``[*B]`` under the policy of values ``[M, *B]``."""
        return values.mean(0)

    def lift(self, score: Tensor, tau: Tensor, tau_prime: Tensor) -> tuple[Tensor, Tensor]:
        """Log-weights ``[M, *B]`` of the target, and its soft value ``[*B]``."""
        log_weights = lifted_log_weights(score, self.log_prob, tau=tau, tau_prime=tau_prime)
        return log_weights, (tau + tau_prime) * log_mean_exp(log_weights, sample_dim=0)

    def divergence_of(self, weights: Tensor, log_weights: Tensor) -> Tensor:
        """KL(target, policy) ``[*B]`` in nats, estimated; from normalised weights ``[M, *B]``."""
        return lift_divergence_estimate(weights, sample_dim=0)

    def auto_entropy(self) -> float:
        """What ``"auto"`` asks for, up to its weight: -A nats, SAC's."""
        return -float(self.action.shape[-1])

    def entropy_range(self, distribution: Distribution) -> tuple[float, Tensor]:
        """Minus infinity, and the log-volume ``[*B]`` of where actions may lie, if it is known."""
        base, transforms = split(distribution)
        low, high = -math.inf, math.inf
        ends = [getattr(base, name, end) for name, end in (("low", low), ("high", high))]
        ends = [torch.zeros_like(self.latent[0]) + end for end in ends]
        for transform in transforms:
            ends = [transform(end) for end in ends]
        log_volume = (ends[1] - ends[0]).abs().log().sum(-1)
        return low, log_volume.nan_to_num(high, high, low)

    def divergence_bound(self, target_kl: float) -> float:
        """In nats, from that per action dimension; which M samples must be able to show."""
        bound, num_samples = self.action.shape[-1] * target_kl, len(self.action)
        if bound >= math.log(num_samples):
            raise ValueError(
                f"target_kl={target_kl} per action dimension bounds KL(target, pi_bar) by "
                f"{bound:.3g} nats, but {num_samples} samples cannot show more than "
                f"log {num_samples} = {math.log(num_samples):.3g}: lower target_kl or raise "
                "num_action_samples."
            )
        return bound


class PairedActions(SampledActions):
    """M actions of a Gaussian policy in antithetic pairs, valued together with their gradient.

    Examples:
        >>> policy = Independent(Normal(torch.zeros(3, 2), torch.ones(3, 2)), 1)  # 3 states, A = 2
        >>> one, other = PairedActions.of(policy, 2).action
        >>> torch.equal(one, -other)
        True
    """

    @classmethod
    def of(cls, distribution: Distribution, num_samples: int) -> SampledActions:
        """Draw half of them, and mirror these about the mean; M must be even."""
        loc, _ = gaussian_parameters(distribution)
        half = split(distribution)[0].rsample(torch.Size([num_samples // 2]))
        return cls.at(torch.cat([half, 2 * loc - half]), distribution)

    def divergence_bound(self, target_kl: float) -> float:
        """In nats, from that per action dimension; gradients show more than M samples can."""
        return self.action.shape[-1] * target_kl


class AllActions(NamedTuple):
    """All n actions of a discrete policy; those that a mask forbids have no part in anything.

    Examples:
        >>> actions = AllActions.of(Categorical(logits=torch.zeros(4)))
        >>> round(actions.mean(torch.tensor([0.0, 0.0, 0.0, 4.0])).item(), 4)
        1.0
    """

    log_prob: Tensor
    """``[n, *B]``; of an action without probability very low, but finite."""

    @classmethod
    def of(cls, distribution: Any) -> AllActions:
        """All actions of a categorical or one-hot policy."""
        log_prob = widened(distribution.logits).log_softmax(-1).movedim(-1, 0)
        is_out = log_prob == -torch.inf
        try:
            mask = getattr(distribution, "mask", None)
        except ValueError as error:
            raise ValueError(
                f"The policy is a {type(distribution).__name__} with indices: give it a boolean "
                "mask of all n actions, which the Q network values."
            ) from error
        if mask is not None:  # TorchRL's, which may fill in what is finite
            is_out = is_out | ~mask.expand_as(distribution.logits).movedim(-1, 0)
        # Minus infinity times 0 would be NaN.
        return cls(log_prob.masked_fill(is_out, _impossible(log_prob)))

    def log_prob_of(self, distribution: Distribution) -> Tensor:
        """Log-probability ``[n, *B]`` under another policy over the same actions."""
        return AllActions.of(distribution).log_prob

    def mean(self, values: Tensor) -> Tensor:
        """Expectation ``[*B]`` under the policy of values ``[n, *B]``."""
        return (self.log_prob.exp() * values).sum(0)

    def lift(self, score: Tensor, tau: Tensor, tau_prime: Tensor) -> tuple[Tensor, Tensor]:
        """Log-weights ``[n, *B]`` of the target, and its soft value ``[*B]``, Eq. 8.

        Nobody has drawn the actions: each counts by its probability.
        """
        temperatures = {"tau": tau, "tau_prime": tau_prime}
        impossible = _impossible(score)
        mask = ~(self.log_prob <= _impossible(self.log_prob))  # NaN is not impossible, but wrong
        log_weights = lifted_log_weights(score, self.log_prob, **temperatures) + self.log_prob
        value = soft_value(score, self.log_prob, **temperatures, sample_dim=0, mask=mask)
        return log_weights.where(mask, impossible), value

    def divergence_of(self, weights: Tensor, log_weights: Tensor) -> Tensor:
        """KL(target, policy) ``[*B]`` in nats; from normalised weights ``[n, *B]``."""
        return (weights * (log_weights.log_softmax(0) - self.log_prob)).sum(0)

    def auto_entropy(self) -> Tensor:
        """What ``"auto"`` asks for, up to its weight: log n ``[*B]`` of the n allowed actions."""
        number = (self.log_prob > _impossible(self.log_prob)).sum(0).clamp_min(1)
        return number.to(self.log_prob.dtype).log()

    def entropy_range(self, distribution: Distribution) -> tuple[float, Tensor]:
        """0, and log n ``[*B]`` of the n actions that a mask leaves."""
        return 0.0, self.auto_entropy()

    def divergence_bound(self, target_kl: float) -> float:
        """In nats, as it is given."""
        return target_kl


Actions = SampledActions | AllActions
"""Either, as :func:`actions_of` returns them."""


def gaussian_parameters(distribution: Distribution) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation ``[*B, A]`` of the (latent) diagonal Gaussian of a policy.

    Raises:
        ValueError: if it is not a diagonal Gaussian, transformed or not.
    """
    base, _ = split(distribution)
    normal = base.base_dist if isinstance(base, Independent) else base
    if not isinstance(normal, Normal):
        raise ValueError(
            "This projection needs a diagonal Gaussian policy, transformed (TanhNormal) or not, "
            f"got {type(distribution).__name__}. Discrete actions belong to DiscreteECACLoss; "
            'ECACLoss(projection="paper") takes any policy with rsample.'
        )
    return normal.loc, normal.scale


def _impossible(like: Tensor) -> float:
    """A log-probability so low that nothing comes of it, and finite."""
    return torch.finfo(like.dtype).min / 4
