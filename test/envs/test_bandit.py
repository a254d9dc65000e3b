from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

from torchrl_ecpo.envs import BanditEnv
from torchrl_ecpo.modules import make_softmax_policy


@pytest.mark.parametrize("transforms", [(), (StepCounter, RewardSum)])
def test_specs(transforms):
    env = BanditEnv(num_actions=5, num_groups=2, group_size=3)
    if transforms:
        env = TransformedEnv(env, Compose(*(transform() for transform in transforms)))
    check_env_specs(env, break_when_any_done="both")


def test_the_paper_s_sizes_and_distribution():
    env = BanditEnv()
    assert env.features.shape == (10_000, 20)
    # E s^8 = 1/9 and the standard deviation of s^8 is about 0.22: four standard errors.
    assert env.rewards.mean().item() == pytest.approx(1 / 9, abs=4 * 0.22 / 100)
    assert 0 <= env.rewards.min() < 1e-6
    assert 0.99 < env.rewards.max() < 1
    assert env.features.mean().abs() < 4 / 200_000**0.5
    assert env.features.std().item() == pytest.approx(1, abs=0.01)


def test_an_instance_is_its_seed():
    first, again, other = (BanditEnv(num_actions=50, instance_seed=s) for s in (1, 1, 2))
    assert torch.equal(first.rewards, again.rewards)
    assert torch.equal(first.features, again.features)
    assert not torch.equal(first.rewards, other.rewards)
    state = torch.get_rng_state()
    BanditEnv(num_actions=50, instance_seed=3)
    assert torch.equal(state, torch.get_rng_state()), "the global generator is left alone"


def test_it_moves_to_another_device_as_a_whole():
    env = BanditEnv(num_actions=5, group_size=2).to("meta")
    assert {buffer.device.type for buffer in env.buffers()} == {"meta"}


def test_an_episode_is_one_action_and_its_reward():
    env = BanditEnv(num_actions=6, num_groups=2, group_size=3)
    td = env.reset()
    td["action"] = torch.tensor([[0, 1, 2], [3, 4, 5]])
    after = env.step(td)["next"]
    assert torch.equal(after["reward"], env.rewards.reshape(2, 3, 1))
    assert after["done"].all()
    assert after["terminated"].all()


def test_groups_are_the_rows_and_unique_across_environments():
    environments = [BanditEnv(num_actions=6, num_groups=2, group_size=3) for _ in range(2)]
    groups = torch.stack([env.reset()["group"] for env in environments])
    assert (groups == groups[..., :1]).all()
    assert groups.unique().numel() == 4


def test_expected_reward_is_what_samples_tend_to():
    torch.manual_seed(0)
    env = BanditEnv(num_actions=20, group_size=20_000, exponent=1)
    policy = make_softmax_policy(env.features)
    for theta in policy.parameters():
        torch.nn.init.normal_(theta, std=0.3)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        probabilities = policy.get_dist(TensorDict({"observation": torch.ones(1)})).probs
        sampled = env.rollout(1, policy)["next", "reward"]
    error = sampled.std() / sampled.numel() ** 0.5
    assert abs(sampled.mean() - env.expected_reward(probabilities)) < 4 * error


@pytest.mark.parametrize("action", [-1, 6])
def test_an_action_that_does_not_exist_is_refused(action):
    env = BanditEnv(num_actions=6, group_size=2)
    td = env.reset()
    td["action"] = torch.tensor([[0, action]])
    with pytest.raises(ValueError, match="integer from 0 to 5, got"):
        env.step(td)
