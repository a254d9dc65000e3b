"""The synthetic bandit of section 5.1."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_ecpo.checks import as_float, check_count, check_kind, described, get_choice
from torchrl_ecpo.envs._groups import GroupIdAllocator

__all__ = ["BanditEnv"]


class BanditEnv(EnvBase):
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
    _group: Tensor

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
        num_groups = check_count("num_groups", num_groups)
        group_size = check_count("group_size", group_size)
        instance_seed = check_count("instance_seed", instance_seed, least=0)
        if not 0 <= as_float("exponent", exponent) < float("inf"):
            raise ValueError(f"exponent must be a finite number >= 0, got {exponent!r}.")
        super().__init__(batch_size=torch.Size([num_groups, group_size]), device=device)
        generator = torch.Generator().manual_seed(instance_seed)
        rewards = torch.rand(num_actions, generator=generator).pow(exponent)
        features = torch.randn(num_actions, num_features, generator=generator)
        self.register_buffer("rewards", rewards.to(self.device))
        self.register_buffer("features", features.to(self.device))
        # One problem instance, so a row's group stays the same from episode to episode.
        group = GroupIdAllocator().allocate(num_groups).to(self.device)
        self.register_buffer("_group", group.unsqueeze(-1).expand(self.batch_size).clone())
        self._make_specs(num_actions)

    def _make_specs(self, num_actions: int) -> None:
        shape = self.batch_size
        one = torch.Size((*shape, 1))
        self.observation_spec = Composite(
            observation=Unbounded(one, dtype=torch.float32),
            group=Unbounded(shape, dtype=torch.int64),
            shape=shape,
        )
        self.action_spec = Composite(action=Categorical(num_actions, shape=shape), shape=shape)
        self.reward_spec = Composite(reward=Unbounded(one), shape=shape)
        flag = Categorical(2, shape=one, dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=shape)

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
        one = (*self.batch_size, 1)
        flag = torch.full(one, done, device=self.device)
        return TensorDict(
            {
                "observation": torch.ones(one, device=self.device),
                "group": self._group.clone(),
                "done": flag,
                "terminated": flag.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _set_seed(self, seed: int | None) -> None:
        """Nothing to seed: `instance_seed` draws the rewards, and an episode is not random."""
