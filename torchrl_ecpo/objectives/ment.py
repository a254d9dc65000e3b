"""Policy gradient with an entropy bonus: MENT, and REINFORCE leave-one-out."""

from __future__ import annotations

from typing import Any, Literal

from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torchrl_ecpo.functional import (
    Surrogate,
    leave_one_out,
    ment_surrogate,
    score_function_loss,
    uniform_weights,
)
from torchrl_ecpo.objectives.trajectory import Score, TrajectoryGroupLoss, TrajectoryGroups

__all__ = ["MENTLoss", "RLOOLoss"]


class MENTLoss(TrajectoryGroupLoss):
    r"""MENT: REINFORCE with an entropy bonus and the group's mean as baseline.

    Williams, "Simple statistical gradient-following algorithms for connectionist reinforcement
    learning", 1992; the baseline of this name in Nachum et al., ICLR 2017. Over the K trajectories
    of a group, drawn from the policy being trained,

    .. math::
        L(\theta) = -\frac1K \sum_k (S_k - \bar S) \log \pi_\theta(\rho_k), \quad
        S_k = r_k - \tau \log \pi_\theta(\rho_k)

    The actor and what is not described here are as in :class:`TrajectoryGroupLoss`.

    Keyword Args:
        tau: temperature of the entropy, in the unit of the score; 0 is plain REINFORCE. Defaults
            to 0.01, the UREX paper's setting for this baseline.

    Raises:
        ValueError: for a `tau` below 0, and as :class:`TrajectoryGroupLoss`.

    Examples:
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> env = BanditEnv(num_actions=6, num_groups=3, group_size=4)
        >>> actor = make_softmax_policy(env.features)
        >>> loss_module = MENTLoss(actor, tau=0.01, reduction="none")
        >>> loss = loss_module(env.rollout(1, actor))  # 3 groups of 4 trajectories of 1 step
        >>> loss["loss_actor"].shape, loss["ESS"]  # all weights are equal
        (torch.Size([3]), tensor([4., 4., 4.]))
    """

    reads_steps = False
    tau: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        tau: float = 0.01,
        score: Score = "return",
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(
            actor_network,
            temperatures={"tau": tau},
            allow_zero=True,
            score=score,
            reduction=reduction,
        )

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """REINFORCE on the score less tau log pi."""
        return ment_surrogate(groups.log_prob, groups.scores, tau=self.tau, mask=groups.mask)


class RLOOLoss(MENTLoss):
    r"""RLOO: REINFORCE with the mean of the other trajectories of the group as baseline.

    Kool, van Hoof and Welling, "Buy 4 REINFORCE Samples, Get a Baseline for Free!", 2019; Ahmadian
    et al., "Back to Basics", ACL 2024. It is :class:`MENTLoss` times K/(K-1), which makes the
    gradient unbiased. Over the K trajectories of a group, drawn from the policy being trained,

    .. math::
        L(\theta) = -\frac1K \sum_k \left(S_k - \frac1{K-1} \sum_{j \ne k} S_j\right)
            \log \pi_\theta(\rho_k), \quad S_k = r_k - \tau \log \pi_\theta(\rho_k)

    The actor and what is not described here are as in :class:`MENTLoss`.

    Keyword Args:
        tau: temperature of the entropy, in the unit of the score. Defaults to 0 (RLOO as
            published).

    Raises:
        ValueError: for a `tau` below 0, and as :class:`TrajectoryGroupLoss`.

    Examples:
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> env = BanditEnv(num_actions=6, num_groups=3, group_size=4)
        >>> actor = make_softmax_policy(env.features)
        >>> loss = RLOOLoss(actor)(env.rollout(1, actor))  # 3 groups of 4 trajectories of 1 step
        >>> loss["loss_actor"].backward()
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        tau: float = 0.0,
        **options: Any,
    ) -> None:
        super().__init__(actor_network, tau=tau, **options)

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """REINFORCE on the score less tau log pi, against the others."""
        mask, log_prob = groups.mask, groups.log_prob
        advantage = leave_one_out(groups.scores - self.tau * log_prob.detach(), mask=mask)
        loss = score_function_loss(log_prob, advantage, mask=mask)
        return Surrogate(loss, uniform_weights(log_prob, mask=mask))
