"""What TorchRL's ``CrossQLoss`` needs of a script: a critic with batch renormalisation."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torchrl.modules import BatchRenorm1d, ValueOperator

WARM_UP = 100_000  # updates of batch normalisation alone; of sbx's CrossQ


class Renorm(BatchRenorm1d):
    """TorchRL's, whose count of batches goes on past the warm-up, and its correction with it."""

    num_batches_tracked: Tensor

    def forward(self, x: Tensor) -> Tensor:
        """Normalise the units of a batch."""
        outputs = super().forward(x)
        # Not clamp_, which vmap has no rule for.
        self.num_batches_tracked.copy_(self.num_batches_tracked.clamp(max=self.warmup_steps))
        return outputs


class Critic(nn.Module):
    """What goes into each layer is normalised, the inputs too, as in Bhatt et al. 2024."""

    def __init__(self, sizes: Sequence[int]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for fan_in, fan_out in pairwise(sizes):
            layers += [Renorm(fan_in, warmup_steps=WARM_UP), nn.Linear(fan_in, fan_out), nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Q ``[B, 1]``."""
        return self.layers(torch.cat([observation, action], -1))


def make_renormalised_critic(
    observation_size: int, action_size: int, hidden_sizes: Sequence[int]
) -> ValueOperator:
    """Q of an action, for ``CrossQLoss``."""
    critic = Critic([observation_size + action_size, *hidden_sizes, 1])
    return ValueOperator(critic, in_keys=["observation", "action"])
