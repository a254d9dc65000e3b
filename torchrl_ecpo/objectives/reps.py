"""Relative entropy policy search."""

from __future__ import annotations

import math
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential

from torchrl_ecpo.checks import as_float, values_can_be_seen
from torchrl_ecpo.functional import Surrogate, lift_divergence_estimate, self_normalised_weights
from torchrl_ecpo.objectives.ecpo import ECPOLoss
from torchrl_ecpo.objectives.trajectory import TrajectoryGroups


class REPSLoss(ECPOLoss):
    r"""REPS: ECPO with a bound on the lift instead of a temperature.

    Peters, Mülling and Altün, "Relative Entropy Policy Search", AAAI 2010: of the targets within
    epsilon nats of the reference, the one with the highest return. Tau minimises the bound's dual,

    .. math::
        g(\tau) = \tau \epsilon + (\tau + \tau') \log \frac1K \sum_k
            \exp \frac{r(\rho_k) - \tau' \log \bar\pi(\rho_k)}{\tau + \tau'}, \qquad
        g'(\tau) = \epsilon - D_{KL}(\bar\pi^* \| \bar\pi)

    in the mean over the groups: ``loss_tau`` is a loss of the parameter ``log_tau`` alone, with the
    gradient g'. Add it to ``loss_actor``.

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.

    Keyword Args:
        epsilon: how far the lift goes, in nats; above 0, and below log K. Defaults to 0.5
            (ours).
        tau: where the temperature starts, in the unit of the score. Defaults to 1.
        tau_prime: temperature of the entropy. Defaults to 0 (REPS has none).
        entropy: see :class:`ECPOLoss`. Defaults to ``"nats"``.
        control_variate: see :class:`ECPOLoss`. Defaults to False.
        score: see :class:`TrajectoryGroupLoss`. Defaults to ``"return"``.
        delay_actor: see :class:`ECPOLoss`. Defaults to False.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

    Raises:
        ValueError: also for an epsilon that is not above 0, or, when called, not below log K.

    Examples:
        >>> import torch
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> env = BanditEnv(num_actions=6, num_groups=3, group_size=4)
        >>> actor = make_softmax_policy(env.features)
        >>> loss_module = REPSLoss(actor, epsilon=0.5)
        >>> loss = loss_module(env.rollout(1, actor))  # 3 groups of 4 trajectories of 1 step
        >>> (loss["loss_actor"] + loss["loss_tau"]).backward()
        >>> torch.allclose(loss_module.log_tau.grad, 0.5 - loss["kl_target_reference"])
        True
    """

    losses, metrics = ("loss_tau",), ("ESS", "max_weight", "tau", "kl_target_reference")

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        epsilon: float = 0.5,
        tau: float = 1.0,
        tau_prime: float = 0.0,
        **options: Any,
    ) -> None:
        super().__init__(actor_network, tau=tau, tau_prime=tau_prime, **options)
        self.epsilon = as_float("epsilon", epsilon)
        if not 0 < self.epsilon < math.inf:
            raise ValueError(f"epsilon must be above 0, in nats, got {epsilon!r}.")
        self.learn("tau", as_float("tau", tau, "(0, inf)"))

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """ECPO's, at the temperature that has been found."""
        size = groups.returns.shape[-1]
        if groups.mask is not None and values_can_be_seen():
            size = int(groups.mask.sum(-1).min())
        if self.epsilon >= math.log(size):
            raise ValueError(
                f"epsilon must be below log K = {math.log(size):.3g}, which is as far as a lift of "
                f"groups of {size} goes, got {self.epsilon}."
            )
        projection = super().surrogate(groups)
        assert projection.weights is not None
        log_base = groups.reference_log_prob - groups.behaviour_log_prob
        divergence = lift_divergence_estimate(
            projection.weights,
            base_weights=self_normalised_weights(log_base, mask=groups.mask),
            mask=groups.mask,
        )
        return projection._replace(
            losses={"loss_tau": self.dual("tau", divergence - self.epsilon)},
            metrics={"tau": self.temperature("tau"), "kl_target_reference": divergence},
        )
