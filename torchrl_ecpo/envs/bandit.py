"""The synthetic bandit of section 5.1."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from torchrl_ecpo.checks import as_float, check_count, check_kind, described, get_choice
from torchrl_ecpo.envs._groups import OneInstance


class BanditEnv(OneInstance):
    """A bandit with many actions, few good ones, and a feature vector for each action.

    Section 5.1 of Mei et al., IJCAI 2019: the reward of action i is s_i^8 with s_i uniform on
    [0, 1), and its feature vector is standard normal in R^20. An episode is one action. The reward
    of an action never varies, so all is known about a policy from its probabilities:
    :meth:`expected_reward`.

    The tensordict holds ``observation`` (float32 ``[num_groups, group_size, 1]``, always 1: there
    is no state), ``action`` (int64 ``[num_groups, group_size]``) and ``group`` (int64, likewise).

    Args:
        num_actions: how many actions; defaults to 10,000, the paper's.
        num_features: length of the feature vectors; defaults to 20, the paper's.
        exponent: of s_i; defaults to 8, the paper's.
        instance_seed: draws rewards and features; the same number gives the same bandit on every
            device. ``set_seed`` has no effect: an episode is not random.
        num_groups: rows of the batch.
        group_size: K, actions drawn from the policy for each group.
        device: where the bandit lives.

    Raises:
        ValueError: if a size is not positive, or another argument negative; when stepped, for an
            action that does not exist.

    Examples:
        >>> env = BanditEnv(num_actions=4, group_size=3)
        >>> env.rollout(1)["next", "reward"].shape  # [num_groups, group_size, T, 1]
        torch.Size([1, 3, 1, 1])
        >>> uniform = torch.full((4,), 0.25)
        >>> torch.isclose(env.expected_reward(uniform), env.rewards.mean())
        tensor(True)
    """

    rewards: Tensor
    features: Tensor

    def __init__(
        self,
        *,
        num_actions: int = 10_000,
        num_features: int = 20,
        exponent: float = 8.0,
        instance_seed: int = 0,
        num_groups: int = 1,
        group_size: int = 100,
        device: torch.device | str | None = None,
    ) -> None:
        num_actions = check_count("num_actions", num_actions)
        num_features = check_count("num_features", num_features)
        instance_seed = check_count("instance_seed", instance_seed, least=0)
        exponent = as_float("exponent", exponent, "[0, inf)")
        super().__init__(num_groups, group_size, device)
        generator = torch.Generator().manual_seed(instance_seed)
        rewards = torch.rand(num_actions, generator=generator).pow(exponent)
        features = torch.randn(num_actions, num_features, generator=generator)
        self.register_buffer("rewards", rewards.to(self.device))
        self.register_buffer("features", features.to(self.device))
        one = torch.Size((*self.batch_size, 1))
        self._set_specs(Unbounded(one, dtype=torch.float32), num_actions)

    def expected_reward(self, probabilities: Tensor) -> Tensor:
        """Exact expected reward ``[...]`` of action probabilities ``[..., num_actions]``."""
        check_kind("probabilities", probabilities, Tensor)
        of_each = probabilities.shape[-1:] == self.rewards.shape[-1:]
        if not of_each or not probabilities.is_floating_point():
            raise ValueError(
                f"probabilities must be floating-point numbers [..., {self.rewards.shape[-1]}], "
                f"one for each action, got {described(probabilities)}."
            )
        return probabilities @ self.rewards.to(probabilities.dtype)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        return self._output(done=False)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = get_choice(tensordict, "action", self.batch_size, self.rewards.shape[-1])
        return self._output(done=True).set("reward", self._reward(action).unsqueeze(-1))

    def _reward(self, action: Tensor) -> Tensor:
        return self.rewards[action]

    def _output(self, *, done: bool) -> TensorDict:
        flag = torch.full((*self.batch_size, 1), done, device=self.device)
        return self._show(torch.ones(flag.shape, device=self.device), flag)
