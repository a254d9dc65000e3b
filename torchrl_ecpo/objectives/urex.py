"""Under-appreciated reward exploration."""

from __future__ import annotations

from typing import Literal

from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torchrl_ecpo.functional import Surrogate, urex_surrogate
from torchrl_ecpo.objectives.trajectory import Score, TrajectoryGroupLoss, TrajectoryGroups


class UREXLoss(TrajectoryGroupLoss):
    r"""UREX: policy gradient plus tau times a mean-seeking projection.

    "Improving Policy Gradient by Exploring Under-appreciated Rewards", Nachum, Norouzi and
    Schuurmans, ICLR 2017. Over the K trajectories of a group, drawn from the policy being trained,

    .. math::
        L(\theta) = -\frac1K \sum_k (S_k - \bar S) \log \pi_\theta(\rho_k), \quad
        S_k = r_k + \tau K\, \mathrm{softmax}_k(r_k / \tau - \log \pi_\theta(\rho_k))

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.

    Keyword Args:
        tau: temperature, in the unit of the score; above 0. Defaults to 0.1, the UREX paper's.
        score: see :class:`TrajectoryGroupLoss`. Defaults to ``"return"``.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

    Raises:
        ValueError: for a `tau` that is not above 0, and as :class:`TrajectoryGroupLoss`.

    Examples:
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> env = BanditEnv(num_actions=6, num_groups=3, group_size=4)
        >>> actor = make_softmax_policy(env.features)
        >>> loss_module = UREXLoss(actor, tau=0.1)
        >>> loss_module.tau = 0.05  # temperatures are scheduled by assignment
        >>> loss = loss_module(env.rollout(1, actor))  # 3 groups of 4 trajectories of 1 step
        >>> loss["loss_actor"].backward()
    """

    reads_steps = False
    tau: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        tau: float = 0.1,
        score: Score = "return",
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(actor_network, temperatures={"tau": tau}, score=score, reduction=reduction)

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """The gradient of the UREX objective."""
        return urex_surrogate(
            groups.log_prob, groups.scores, tau=self.temperature("tau"), mask=groups.mask
        )
