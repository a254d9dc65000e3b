"""Policy Mirror Descent by regression, as in Kimi k1.5."""

from __future__ import annotations

from typing import Any, Literal

from tensordict.nn import ProbabilisticTensorDictSequential

from torchrl_ecpo.checks import check_choice
from torchrl_ecpo.functional import Surrogate, squared_residual_projection
from torchrl_ecpo.objectives.trajectory import LiftProjectLoss, TrajectoryGroups


class SquaredPMDLoss(LiftProjectLoss):
    r"""Squared PMD: lift, and project by regression of log pi on the log of the target.

    Kimi Team, "Kimi k1.5", 2025, section 2.3.2: the twin of :class:`PMDLoss`, which has the same
    target and, at pi = pi_bar, the same gradient. Over the K trajectories of a group, drawn from
    the reference,

    .. math::
        L(\theta) = \frac1{2 \tau K} \sum_k \left( r_k - \tau \log Z
            - \tau \log \frac{\pi_\theta(\rho_k)}{\bar\pi(\rho_k)} \right)^2, \quad
        \tau \log Z = \bar r \;\;\text{or}\;\; \tau \log \frac1K \sum_k \exp \frac{r_k}{\tau}

    and with ``tau_prime > 0`` for :class:`ECPOLoss`'s target. Kimi's own is 2 tau times that.

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.

    Keyword Args:
        tau: temperature of the divergence from the reference policy, in the unit of the score.
            Defaults to 0.5, as :class:`ECPOLoss`.
        tau_prime: temperature of the entropy. Defaults to 0 (Kimi k1.5).
        normaliser: of the target: ``"mean"`` (default, Kimi's in practice), the mean return, or
            ``"soft"``, the soft value.
        score: see :class:`TrajectoryGroupLoss`. Defaults to ``"return"``.
        delay_actor: see :class:`ECPOLoss`. Defaults to False.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

    Raises:
        ValueError: for an unknown `normaliser`, temperatures below 0 or both 0, and as
            :class:`TrajectoryGroupLoss`.

    Examples:
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> env = BanditEnv(num_actions=6, num_groups=3, group_size=4)
        >>> actor = make_softmax_policy(env.features)
        >>> loss_module = SquaredPMDLoss(actor, tau=0.5, normaliser="soft")
        >>> loss = loss_module(env.rollout(1, actor))  # 3 groups of 4 trajectories of 1 step
        >>> loss["loss_actor"].backward()
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        normaliser: Literal["mean", "soft"] = "mean",
        **options: Any,
    ) -> None:
        super().__init__(actor_network, **options)
        check_choice("normaliser", normaliser, ("mean", "soft"))
        self.normaliser = normaliser

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """The squared residual in the unit of the score."""
        projection = squared_residual_projection(
            groups.log_prob,
            groups.reference_log_prob,
            self.lift(groups),
            normaliser=self.normaliser,
            behaviour_log_prob=groups.behaviour_log_prob,
            mask=groups.mask,
        )
        return projection._replace(loss=sum(self.temperatures()) * projection.loss)
