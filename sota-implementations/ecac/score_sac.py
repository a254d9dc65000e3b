"""SAC with the score-function policy gradient, which the paper calls "SAC"."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss

from torchrl_ecpo._torchrl import holding


class ScoreSACLoss(SACLoss):
    r"""TorchRL's ``SACLoss`` with a V network, but for how the policy follows Q.

    TorchRL has no SAC without reparameterisation. Here the gradient through the action is replaced
    by that of its log-probability, with V as baseline:

    .. math:: \log\pi_\theta(a|s) \, [\alpha \log\pi(a|s) - Q(s, a) + V(s)], \quad a \sim \pi

    where the bracket is held fixed. In expectation the two gradients are the same.
    """

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of the policy, and the log-probabilities by which alpha is learned."""
        critic: Any = self.qvalue_network
        log_alpha: Any = self.log_alpha
        value_network: Any = self.value_network
        value_params: Any = self.value_network_params
        state = tensordict.select(*self.actor_network.in_keys)
        with (
            set_exploration_type(ExplorationType.RANDOM),
            holding(self.actor_network, self.actor_network_params),
        ):
            distribution: Any = self.actor_network.get_dist(state)
            action, log_prob = distribution.sample_and_log_prob()
        with torch.no_grad():
            state.set(self.tensor_keys.action, action)
            qvalues = critic.each(state, self.qvalue_network_params)
            qvalue = qvalues.get(self.tensor_keys.state_action_value).min(0)[0].squeeze(-1)
            with holding(value_network, value_params):
                value = value_network(state).get(self.tensor_keys.value).squeeze(-1)
            signal = log_alpha.exp() * log_prob - qvalue + value
        return (log_prob * signal).mean(), {"log_prob": log_prob.detach()}
