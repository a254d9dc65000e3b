"""Exploratory Conservative Policy Optimization."""

from __future__ import annotations

from typing import Literal

from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torchrl_ecpo.checks import check_choice, check_flag
from torchrl_ecpo.functional import (
    Surrogate,
    lifted_log_weights,
    matched_temperature,
    mean_seeking_projection,
)
from torchrl_ecpo.objectives.trajectory import LiftProjectLoss, Score, TrajectoryGroups


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
        control_variate: if True, the self-normalised ratios of pi_theta to the policy that drew the
            trajectories are subtracted from the weights, which removes the drift of groups without
            a preference. Defaults to False (the paper).
        score: see :class:`TrajectoryGroupLoss`. Defaults to ``"return"``.
        delay_actor: if True, the reference policy is the loss's own delayed copy of the actor, see
            :class:`TrajectoryGroupLoss`. Defaults to False: the recorded log-probability is the
            reference's, as in Algorithm 1.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

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
        tau: float = 0.5,
        tau_prime: float = 0.01,
        entropy: Literal["nats", "matched"] = "nats",
        control_variate: bool = False,
        score: Score = "return",
        delay_actor: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(
            actor_network,
            tau=tau,
            tau_prime=tau_prime,
            score=score,
            delay_actor=delay_actor,
            reduction=reduction,
        )
        check_choice("entropy", entropy, ("nats", "matched"))
        if entropy == "matched" and score == "return":
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
