"""Under-appreciated reward exploration."""

from __future__ import annotations

from typing import Literal

from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from torchrl_ecpo.functional import Surrogate, urex_surrogate
from torchrl_ecpo.objectives.trajectory import TrajectoryGroupLoss, TrajectoryGroups

__all__ = ["UREXLoss"]


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
        tau: temperature, in the unit of the return; above 0. Defaults to 0.1, the UREX paper's.
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
        >>> loss_module = UREXLoss(actor, tau=0.1)
        >>> loss_module.tau = 0.05  # temperatures are scheduled by assignment
        >>> loss = loss_module(TensorDict({
        ...     "observation": torch.randn(4, 5, 2),  # one group of 4 trajectories of 5 steps
        ...     "action": torch.randint(6, (4, 5)),
        ...     "action_log_prob": torch.full((4, 5), -1.8),
        ...     "next": {"reward": torch.rand(4, 5, 1)},
        ... }, batch_size=[4, 5]))
        >>> loss["loss_actor"].backward()
    """

    tau: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        tau: float = 0.1,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(actor_network, temperatures={"tau": tau}, reduction=reduction)

    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """The gradient of the UREX objective."""
        return urex_surrogate(groups.log_prob, groups.returns, tau=self.tau, mask=groups.mask)
