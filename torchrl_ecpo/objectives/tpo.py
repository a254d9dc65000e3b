"""Target policy optimisation."""

from __future__ import annotations

from typing import Literal

from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torchrl_ecpo.checks import check_flag
from torchrl_ecpo.functional import Surrogate, group_cross_entropy
from torchrl_ecpo.objectives.trajectory import Score, TrajectoryGroupLoss, TrajectoryGroups


class TPOLoss(TrajectoryGroupLoss):
    r"""TPO: lift within the group, project by the cross-entropy of the group's softmaxes.

    Kaddour, "Target Policy Optimization", 2026 (arXiv:2604.06159). Over the K trajectories of a
    group, with u their standardised returns,

    .. math::
        L(\theta) = -\sum_k q_k \log p_k, \quad
        q = \mathrm{softmax}_k\left(\frac{u_k}{\tau} + \log \bar\pi(\rho_k)\right), \quad
        p = \mathrm{softmax}_k \log \pi_\theta(\rho_k)

    The trajectories are the reference's own, so that their probability counts twice: q are
    :class:`ECPOLoss`'s weights with an entropy term of the other sign,
    tau_prime / (tau + tau_prime) = -1.

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.

    Keyword Args:
        tau: temperature, in the unit of the score: the paper's eta. Defaults to 1 (the paper).
        score: u, see :class:`TrajectoryGroupLoss`. Defaults to ``"group"`` (the paper).
        length_norm: if True, log-probabilities are divided by the number of steps, in p and in q.
            Defaults to False.
        delay_actor: see :class:`ECPOLoss`. Defaults to False. Nothing corrects for another policy
            that drew the trajectories.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

    Raises:
        ValueError: for a `tau` that is not above 0, a `length_norm` that is no bool, and as
            :class:`TrajectoryGroupLoss`.

    Examples:
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> env = BanditEnv(num_actions=6, num_groups=3, group_size=4)
        >>> actor = make_softmax_policy(env.features)
        >>> loss = TPOLoss(actor)(env.rollout(1, actor))  # 3 groups of 4 trajectories of 1 step
        >>> loss["loss_actor"].backward()
    """

    tau: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        tau: float = 1.0,
        score: Score = "group",
        length_norm: bool = False,
        delay_actor: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(
            actor_network,
            temperatures={"tau": tau},
            score=score,
            delay_actor=delay_actor,
            reduction=reduction,
        )
        self.length_norm = self.reads_steps = check_flag("length_norm", length_norm)

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """The cross-entropy; its weights are q."""
        log_prob, reference = groups.log_prob, groups.reference_log_prob
        if self.length_norm:
            length = groups.num_steps.clamp_min(1)
            log_prob, reference = log_prob / length, reference / length
        return group_cross_entropy(
            log_prob, groups.scores / self.temperature("tau") + reference, mask=groups.mask
        )
