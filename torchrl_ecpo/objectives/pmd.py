"""Policy Mirror Descent."""

from __future__ import annotations

from torchrl_ecpo.functional import Surrogate, mode_seeking_projection
from torchrl_ecpo.objectives.trajectory import LiftProjectLoss, TrajectoryGroups

__all__ = ["PMDLoss"]


class PMDLoss(LiftProjectLoss):
    r"""PMD: lift, and project by the mode-seeking KL(pi, target).

    "On Principled Entropy Exploration in Policy Optimization", Mei et al., IJCAI 2019, Eq. 2, 3 and
    footnote 1: the gradient of

    .. math::
        -\mathbb{E}_{\rho \sim \pi_\theta} r(\rho) + \tau D_{KL}(\pi_\theta \| \bar\pi)
        - \tau' H(\pi_\theta) = (\tau + \tau') D_{KL}(\pi_\theta \| \bar\pi^*) + const

    by self-normalised importance sampling from the reference policy. ``tau_prime = 0`` is PMD,
    ``tau_prime > 0`` the paper's PMD+entropy. At pi = pi_bar it is REINFORCE with the group's mean
    as baseline.

    Args:
        actor_network: a policy with ``get_dist``, see :class:`TrajectoryGroupLoss`.

    Keyword Args:
        tau: temperature of the divergence from the reference policy, in the unit of the return.
            Defaults to 0.5, as :class:`ECPOLoss`.
        tau_prime: temperature of the entropy. Defaults to 0 (the paper's PMD).
        delay_actor: if True, the reference policy is the loss's own delayed copy of the actor, see
            :class:`TrajectoryGroupLoss`. Defaults to False: the recorded log-probability is the
            reference's, as in Algorithm 1.
        reduction: ``"mean"`` over groups (default), ``"sum"`` or ``"none"``.

    Examples:
        The batch is that of :class:`ECPOLoss`, and so is the call without a tensordict.

        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torch.distributions import Categorical
        >>> from torchrl.modules import ProbabilisticActor
        >>> network = TensorDictModule(torch.nn.Linear(2, 6), ["observation"], ["logits"])
        >>> actor = ProbabilisticActor(network, in_keys=["logits"], distribution_class=Categorical)
        >>> loss_module = PMDLoss(actor, tau=0.5)
        >>> loss = loss_module(TensorDict({
        ...     "observation": torch.randn(4, 5, 2),  # one group of 4 trajectories of 5 steps
        ...     "action": torch.randint(6, (4, 5)),
        ...     "action_log_prob": torch.full((4, 5), -1.8),
        ...     "next": {"reward": torch.rand(4, 5, 1)},
        ... }, batch_size=[4, 5]))
        >>> loss["loss_actor"].backward()
    """

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """Eq. 3 in the unit of the return: the projection's gradient times tau + tau'."""
        projection = mode_seeking_projection(
            groups.log_prob,
            groups.reference_log_prob,
            self.lift(groups),
            behaviour_log_prob=groups.behaviour_log_prob,
            mask=groups.mask,
        )
        return projection._replace(loss=(self.tau + self.tau_prime) * projection.loss)
