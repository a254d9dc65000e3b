"""Maximum-entropy policy gradient."""

from __future__ import annotations

from typing import Literal

from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torchrl_ecpo.functional import Surrogate, ment_surrogate
from torchrl_ecpo.objectives.trajectory import Score, TrajectoryGroupLoss, TrajectoryGroups


class MENTLoss(TrajectoryGroupLoss):
    r"""MENT: REINFORCE with an entropy bonus and the group's mean as baseline.

    Williams, "Simple statistical gradient-following algorithms for connectionist reinforcement
    learning", 1992; the baseline of this name in Nachum et al., ICLR 2017. Over the K trajectories
    of a group, drawn from the policy being trained,

    .. math::
        L(\theta) = -\frac1K \sum_k (S_k - \bar S) \log \pi_\theta(\rho_k), \quad
        S_k = r_k - \tau \log \pi_\theta(\rho_k)

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.

    Keyword Args:
        tau: temperature of the entropy, in the unit of the score; 0 is plain REINFORCE. Defaults
            to 0.01, the UREX paper's setting for this baseline.
        score: see :class:`TrajectoryGroupLoss`. Defaults to ``"return"``.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

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
        return ment_surrogate(
            groups.log_prob, groups.scores, tau=self.temperature("tau"), mask=groups.mask
        )
