"""REINFORCE leave-one-out."""

from __future__ import annotations

from typing import Literal

from tensordict.nn import ProbabilisticTensorDictSequential

from torchrl_ecpo.functional import (
    Surrogate,
    leave_one_out,
    score_function_loss,
    uniform_weights,
)
from torchrl_ecpo.objectives.ment import MENTLoss
from torchrl_ecpo.objectives.trajectory import Score, TrajectoryGroups


class RLOOLoss(MENTLoss):
    r"""RLOO: REINFORCE with the mean of the other trajectories of the group as baseline.

    Kool, van Hoof and Welling, "Buy 4 REINFORCE Samples, Get a Baseline for Free!", 2019; Ahmadian
    et al., "Back to Basics", ACL 2024. It is :class:`MENTLoss` times K/(K-1), which makes the
    gradient unbiased. Over the K trajectories of a group, drawn from the policy being trained,

    .. math::
        L(\theta) = -\frac1K \sum_k \left(S_k - \frac1{K-1} \sum_{j \ne k} S_j\right)
            \log \pi_\theta(\rho_k), \quad S_k = r_k - \tau \log \pi_\theta(\rho_k)

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.

    Keyword Args:
        tau: temperature of the entropy, in the unit of the score. Defaults to 0 (RLOO as
            published).
        score: see :class:`TrajectoryGroupLoss`. Defaults to ``"return"``.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

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
        score: Score = "return",
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(actor_network, tau=tau, score=score, reduction=reduction)

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """REINFORCE on the score less tau log pi, against the others."""
        mask, log_prob = groups.mask, groups.log_prob
        advantage = leave_one_out(
            groups.scores - self.temperature("tau") * log_prob.detach(), mask=mask
        )
        loss = score_function_loss(log_prob, advantage, mask=mask)
        return Surrogate(loss, uniform_weights(log_prob, mask=mask))
