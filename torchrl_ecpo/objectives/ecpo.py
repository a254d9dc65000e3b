"""Exploratory Conservative Policy Optimization, and relative entropy policy search by its lift."""

from __future__ import annotations

import math
from typing import Any, Literal

from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torchrl_ecpo.checks import as_float, check_choice, check_flag
from torchrl_ecpo.functional import (
    Surrogate,
    lift_divergence_estimate,
    lifted_log_weights,
    matched_temperature,
    mean_seeking_projection,
    self_normalised_weights,
)
from torchrl_ecpo.objectives.trajectory import LiftProjectLoss, TrajectoryGroups

__all__ = ["ECPOLoss", "REPSLoss"]


class ECPOLoss(LiftProjectLoss):
    r"""ECPO: lift with an entropy term, project by the mean-seeking KL(target, pi).

    "On Principled Entropy Exploration in Policy Optimization", Mei et al., IJCAI 2019, Eq. 4 to 6
    and Algorithm 1. Over the K trajectories of a group,

    .. math::
        L(\theta) = -\sum_k w_k \log \pi_\theta(\rho_k), \quad
        w = \mathrm{softmax}_k \frac{r(\rho_k) - \tau' \log \bar\pi(\rho_k)}{\tau + \tau'}

    Several gradient steps, each on fresh trajectories of the same reference policy pi_bar, make up
    one projection.

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.

    Keyword Args:
        tau: temperature of the divergence from the reference policy, in the unit of the score.
            Defaults to 0.5, the middle of the values searched on the algorithmic tasks (rewards of
            1 a symbol), where 0.25 or 1 was best.
        tau_prime: temperature of the entropy, in the unit of the score. What matters is
            tau_prime / (tau + tau_prime). Defaults to 0.01, where the runs on the same tasks
            start; anneal it towards 0 where the task asks for a deterministic policy. 0 is the
            paper's ablation.
        entropy: what tau_prime weighs. ``"nats"`` (default, the paper's): the surprise
            -log pi_bar(rho). ``"matched"``: the surprise scaled so that it spreads within groups as
            far as the scores do (:func:`~torchrl_ecpo.functional.matched_temperature`); one
            tau_prime then serves short and long trajectories, early and late. Needs scores in
            deviations: ``score="group"`` or ``"batch"``.
        control_variate: if True, the self-normalised ratios pi_theta/pi_bar are subtracted from
            the weights, which removes the drift of groups without a preference. Defaults to False
            (the paper).
        options: ``score``, ``delay_actor`` and ``reduction``, see :class:`TrajectoryGroupLoss`.

    Raises:
        ValueError: for an unknown `entropy`, for ``"matched"`` with ``score="return"``, and as
            :class:`TrajectoryGroupLoss`.

    Examples:
        A batch of 3 groups of K = 4 trajectories of T = 5 steps:

        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torch.distributions import Categorical
        >>> from torchrl.modules import ProbabilisticActor
        >>> network = TensorDictModule(torch.nn.Linear(2, 6), ["observation"], ["logits"])
        >>> actor = ProbabilisticActor(
        ...     network, in_keys=["logits"], distribution_class=Categorical, return_log_prob=True)
        >>> loss_module = ECPOLoss(actor, tau=0.5, tau_prime=0.01)
        >>> batch = TensorDict({
        ...     "observation": torch.randn(3, 4, 5, 2),
        ...     "action": torch.randint(6, (3, 4, 5)),
        ...     "action_log_prob": torch.full((3, 4, 5), -1.8),
        ...     "next": {"reward": torch.rand(3, 4, 5, 1)},
        ... }, batch_size=[3, 4, 5])
        >>> loss = loss_module(batch)
        >>> loss["loss_actor"].backward()

        It can also be called without a tensordict. The keywords are ``in_keys`` joined by ``_``
        (here ``observation``, ``action``, ``next_reward``, ``action_log_prob`` and, optionally,
        ``collector_mask``), and a tuple is returned in the order of ``out_keys``:

        >>> loss_actor, ess, *_ = loss_module(
        ...     observation=batch["observation"], action=batch["action"],
        ...     next_reward=batch["next", "reward"], action_log_prob=batch["action_log_prob"])
        >>> torch.equal(loss_actor, loss["loss_actor"])
        True
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        tau_prime: float = 0.01,
        entropy: Literal["nats", "matched"] = "nats",
        control_variate: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(actor_network, tau_prime=tau_prime, **options)
        check_choice("entropy", entropy, ("nats", "matched"))
        if entropy == "matched" and self.score == "return":
            raise ValueError(
                "entropy='matched' needs scores in deviations: score='group' or 'batch', got "
                "score='return'."
            )
        self.entropy = entropy
        self.control_variate = check_flag("control_variate", control_variate)

    def lift(self, groups: TrajectoryGroups) -> Tensor:
        """Eq. 5, at the matched tau' if that is asked for."""
        tau, tau_prime = self.temperatures()
        score, reference = groups.scores, groups.reference_log_prob
        if self.entropy == "matched":
            tau_prime = matched_temperature(tau_prime, score, reference, mask=groups.mask)
        return lifted_log_weights(score, reference, tau=tau, tau_prime=tau_prime)

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """Eq. 6, with weights corrected for the policy that drew the trajectories."""
        behaviour = groups.behaviour_log_prob
        return mean_seeking_projection(
            groups.log_prob,
            self.lift(groups) + groups.reference_log_prob - behaviour,
            control_log_prob=behaviour if self.control_variate else None,
            mask=groups.mask,
        )


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

    The actor and what is not described here are as in :class:`ECPOLoss`.

    Keyword Args:
        epsilon: how far the lift goes, in nats; above 0, and below log K. Defaults to 0.5
            (ours).
        tau: where the temperature starts, in the unit of the score. Defaults to 1.
        tau_prime: temperature of the entropy. Defaults to 0 (REPS has none).

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
        self.learn("tau", float(tau))

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """ECPO's, at the temperature that has been found."""
        size = groups.returns.shape[-1]
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
