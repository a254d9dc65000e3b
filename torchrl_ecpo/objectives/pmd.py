"""Policy Mirror Descent."""

from __future__ import annotations

from torchrl_ecpo.functional import Surrogate, mode_seeking_projection
from torchrl_ecpo.objectives.trajectory import LiftProjectLoss, TrajectoryGroups


class PMDLoss(LiftProjectLoss):
    r"""PMD: lift, and project by the mode-seeking KL(pi, target).

    "On Principled Entropy Exploration in Policy Optimization", Mei et al., IJCAI 2019, Eq. 2, 3 and
    footnote 1: the gradient of

    .. math::
        -\mathbb{E}_{\rho \sim \pi_\theta} r(\rho) + \tau D_{KL}(\pi_\theta \| \bar\pi)
        - \tau' H(\pi_\theta) = (\tau + \tau') D_{KL}(\pi_\theta \| \bar\pi^*) + const

    by self-normalised importance sampling from the reference policy. ``tau_prime = 0`` is PMD,
    ``tau_prime > 0`` the paper's PMD+entropy. At pi = pi_bar and tau_prime = 0 it is REINFORCE
    with the group's mean as baseline.

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.

    Keyword Args:
        tau: temperature of the divergence from the reference policy, in the unit of the score.
            Defaults to 0.5, as :class:`ECPOLoss`.
        tau_prime: temperature of the entropy. Defaults to 0 (the paper's PMD).
        score: see :class:`TrajectoryGroupLoss`. Defaults to ``"return"``.
        delay_actor: see :class:`ECPOLoss`. Defaults to False.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

    Raises:
        ValueError: for temperatures below 0 or both 0, and as :class:`TrajectoryGroupLoss`.

    Examples:
        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> env = BanditEnv(num_actions=6, num_groups=3, group_size=4)
        >>> actor = make_softmax_policy(env.features)
        >>> loss_module = PMDLoss(actor, tau=0.5)
        >>> loss = loss_module(env.rollout(1, actor))  # 3 groups of 4 trajectories of 1 step
        >>> loss["loss_actor"].backward()
    """

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """Eq. 3 in the unit of the score: the projection's gradient times tau + tau'."""
        projection = mode_seeking_projection(
            groups.log_prob,
            groups.reference_log_prob,
            self.lift(groups),
            behaviour_log_prob=groups.behaviour_log_prob,
            mask=groups.mask,
        )
        return projection._replace(loss=sum(self.temperatures()) * projection.loss)
