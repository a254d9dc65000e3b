"""The deep sea of bsuite: one treasure, which only directed exploration finds."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Categorical

from torchrl_ecpo.checks import check_count, get_choice
from torchrl_ecpo.envs._groups import OneInstance


class DeepSeaEnv(OneInstance):
    r"""A diver in a square of `size` x `size` cells, one row lower after each step.

    The problem of Osband et al., Behaviour Suite for Reinforcement Learning (ICLR 2020), with its
    rules and without noise. The diver starts at the upper left. One of two actions moves it right,
    which costs 0.01 / `size`, the other left; which is which is drawn for each cell. Moving right
    in the last column earns 1: only a diver that has always moved right comes there. So the best
    return is 0.99, a policy that never moves right earns 0, and the uniform policy finds the
    treasure in :math:`2^{-N}` of the episodes.

    The tensordict holds ``observation`` (int64 ``[num_groups, group_size]``: the cell, `size` *
    row + column, and `size`\ :sup:`2` at the end), ``action`` (int64, likewise, 0 or 1) and
    ``group`` (int64, likewise).

    Args:
        size: N, rows, columns, and steps of an episode; defaults to 10, bsuite's smallest.
        instance_seed: draws which action moves right, the same on every device. ``set_seed`` has
            no effect: an episode is not random.
        num_groups: rows of the batch; all play the one instance.
        group_size: K, episodes of a group.
        device: where it lives.

    Raises:
        ValueError: if a size is not positive, or the seed negative; when stepped, for an action or
            a cell that does not exist.

    Examples:
        >>> env = DeepSeaEnv(2, group_size=3)
        >>> env.rollout(10)["observation"].shape  # [num_groups, group_size, T]
        torch.Size([1, 3, 2])
    """

    right: Tensor

    def __init__(
        self,
        size: int = 10,
        *,
        instance_seed: int = 0,
        num_groups: int = 1,
        group_size: int = 100,
        device: torch.device | str | None = None,
    ) -> None:
        self.size = check_count("size", size)
        instance_seed = check_count("instance_seed", instance_seed, least=0)
        super().__init__(num_groups, group_size, device)
        generator = torch.Generator().manual_seed(instance_seed)
        right = torch.randint(2, (self.size**2 + 1,), generator=generator)
        self.register_buffer("right", right.to(self.device))
        self._set_specs(Categorical(self.size**2 + 1, shape=self.batch_size), 2)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        return self._output(torch.zeros(self.batch_size, dtype=torch.int64, device=self.device))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        size, shape = self.size, self.batch_size
        cell = get_choice(tensordict, "observation", shape, size**2 + 1)
        is_right = get_choice(tensordict, "action", shape, 2) == self.right[cell]
        row, column = cell // size, cell % size
        reward = is_right * ((column == size - 1).float() - 0.01 / size)
        column = (column + 2 * is_right - 1).clamp(0, size - 1)
        after = (size * (row + 1) + column).clamp(max=size**2)
        return self._output(after).set("reward", reward.unsqueeze(-1))

    def _output(self, cell: Tensor) -> TensorDictBase:
        return self._show(cell, (cell == self.size**2).unsqueeze(-1))
