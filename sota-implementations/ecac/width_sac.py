"""SAC with less entropy for the width of the policy alone, as ``ECACLoss`` may have it."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss

from torchrl_ecpo._torchrl import holding
from torchrl_ecpo.checks import as_float
from torchrl_ecpo.objectives.actions import gaussian_parameters


class WidthSACLoss(SACLoss):
    r"""TorchRL's ``SACLoss`` with one term more in the loss of the policy; with phi = 1, without.

    Of a tanh-Gaussian policy SAC's :math:`\alpha \log\pi` is
    :math:`-\alpha \sum \log\sigma - \alpha \log|da/du|` and a constant. The first term, which
    reaches the width alone, is multiplied by phi:

    .. math:: L(\theta) = L_{SAC}(\theta) + \alpha (1 - \varphi) \sum \log\sigma_\theta

    So this is no longer SAC: the policy is narrower than the one that maximises SAC's objective.
    Q, alpha and its target entropy count the whole entropy, as before.

    Keyword Args:
        width_entropy: phi, from 0 to 1. Default: 1, SAC.
    """

    def __init__(self, *networks: Any, width_entropy: float = 1.0, **options: Any) -> None:
        super().__init__(*networks, **options)
        self.width_entropy = as_float("width_entropy", width_entropy, "[0, 1]")

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of the policy, and the log-probabilities by which alpha is learned."""
        loss, log_prob = super().actor_loss(tensordict)
        if self.width_entropy == 1:
            return loss, log_prob
        log_alpha: Any = self.log_alpha
        with (
            set_exploration_type(ExplorationType.RANDOM),
            holding(self.actor_network, self.actor_network_params),
        ):
            _, scale = gaussian_parameters(self.actor_network.get_dist(tensordict))
        width = scale.log().sum(-1).mean()
        return loss + (1 - self.width_entropy) * log_alpha.detach().exp() * width, log_prob
