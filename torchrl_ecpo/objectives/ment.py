"""Maximum-entropy policy gradient."""

from __future__ import annotations

from typing import Literal

from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torchrl_ecpo.functional import Surrogate, ment_surrogate
from torchrl_ecpo.objectives.trajectory import TrajectoryGroupLoss, TrajectoryGroups

__all__ = ["MENTLoss"]


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
        tau: temperature of the entropy, in the unit of the return; 0 is plain REINFORCE. Defaults
            to 0.01, the UREX paper's setting for this baseline.
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
        >>> loss_module = MENTLoss(actor, tau=0.01, reduction="none")
        >>> loss = loss_module(TensorDict({
        ...     "observation": torch.randn(3, 4, 5, 2),
        ...     "action": torch.randint(6, (3, 4, 5)),
        ...     "action_log_prob": torch.full((3, 4, 5), -1.8),
        ...     "next": {"reward": torch.rand(3, 4, 5, 1)},
        ... }, batch_size=[3, 4, 5]))
        >>> loss["loss_actor"].shape, loss["ESS"]  # all weights are equal
        (torch.Size([3]), tensor([4., 4., 4.]))
    """

    tau: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        tau: float = 0.01,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(
            actor_network, temperatures={"tau": tau}, allow_zero=True, reduction=reduction
        )

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """REINFORCE on the return less tau log pi."""
        return ment_surrogate(groups.log_prob, groups.returns, tau=self.tau, mask=groups.mask)
